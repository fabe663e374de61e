"""The base classes of the driving track: World, Policy, Victim, Attack and Defense of a driver on a highway."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, ClassVar

from torch import Tensor

from bench.driving.features import ActionType, Driver, DrivingFacts, Features
from bench.driving.oracle import Oracle
from bench.driving.policy import Policy, State
from bench.driving.threat import ObservationThreat
from bench.plugins.contracts import Attack, Defense, Progress, ThreatModel, Trained, Victim, World
from bench.scenarios import Cell

if TYPE_CHECKING:
    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase


class DrivingWorld(World):
    """Makes TorchRL environments for the cells of a grid.

    The environments are batched ([B] episodes), take an explicit scenario seed an episode in the reset tensordict (`seed`,
    int64 [B]; without it seeds are drawn from `set_seed`), and write under `("next", ...)`:
    `observation` float32 [B, V, F]; `reward` float32 [B, 1]; `done`, `terminated`, `truncated` bool [B, 1]; and `info`, the
    ground truth that scoring reads and no policy or attack may: `progress` (Eq. 4.1 without its offset, over 0.5, in [0, 1]),
    `speed` m/s, `x` m, `ttc` s (time to collision with the car ahead in the ego's lane, inf if none), each float32 [B, 1],
    `crashed` and `offroad` bool [B, 1].
    """

    track: ClassVar[str] = "driving"
    features: ClassVar[Features]
    actions: ClassVar[tuple[str, ...]]
    """Names of the discrete actions, by number."""
    max_steps: int
    """Decisions of an episode that runs to its end."""
    drivers: ClassVar[tuple[Driver, ...]] = ("agent",)
    """Who may be at the wheel, see `make`."""

    @property
    @abstractmethod
    def decision_hz(self) -> float:
        """Decisions a second."""

    @property
    def facts(self) -> DrivingFacts:
        return DrivingFacts(
            axes=self.axes,
            decision_hz=self.decision_hz,
            max_steps=self.max_steps,
            actions=self.actions,
            features=self.features,
            drivers=self.drivers,
        )

    @abstractmethod
    def make(
        self,
        cells: Sequence[Cell],
        *,
        action_type: ActionType = "discrete",
        driver: Driver = "agent",
        action_repeat: int = 1,
    ) -> EnvBase:
        """An environment of len(cells) episodes, episode b on cells[b].

        Args:
            cells: the cell of each episode of the batch.
            action_type: discrete lane-changing actions, or continuous [acceleration, steering] in [-1, 1].
            driver: `agent` obeys the actions; `idm` lets the world's own rule-based driver steer and ignores them.
            action_repeat: frames a decision is held (training only): lane changes are sent once, the rest is repeated;
                reward and progress are summed over the frames, an episode stops where it ends.
        """


class DrivingVictim(Victim):
    """A kind of driver; fields are its hyper-parameters."""

    track: ClassVar[str] = "driving"
    network: ClassVar[type[Policy]] = Policy
    threat: ClassVar[type[ThreatModel]] = ObservationThreat
    policy_type: ClassVar[type[Policy] | None] = None
    """The class of its trained policies, which the zoo builds from a card."""

    @property
    @abstractmethod
    def action_type(self) -> ActionType:
        """Whether it takes discrete lane-changing decisions or steers itself."""

    @abstractmethod
    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        """The policy of training seed `seed`, in eval mode, without gradients on its weights.

        Args:
            seed: training seed.
            facts: of the world it is going to drive in.

        Raises:
            bench.errors.UserError: if the zoo has no such policy, saying which command trains it.
        """

    def train(
        self, world: DrivingWorld, *, seed: int, hooks: TrainingHooks | None = None, progress: Progress
    ) -> Trained[Policy]:
        """Train from fresh weights (or from `hooks.start`), with the changes that the hooks of a defence make."""
        raise NotImplementedError(f"{type(self).__name__} does not learn")


class TrainingHooks:
    """What a defence may change in the training of a driver; each default leaves the training as it is.

    Observations are [B, V, F], `share` is the share of the training that is done, in [0, 1], and `policy` is the network that
    is being trained: its `scores` have gradients to the weights, its `value` is a copy of the critic.
    """

    start: Policy | None = None
    """The trained policy to continue from, frame by frame; None trains from fresh weights."""
    decisions: int = 0
    """Length of the training on every road, where there is a `start`."""
    off_policy: bool = False
    """Whether actions are often not those the policy would take: n-step returns then stay short."""
    checkpoints: float = 1.0
    """Share of the victim's checkpoints that are scored, in (0, 1]; for hooks whose scoring is expensive."""

    def acting(self, observation: Tensor, policy: Policy, share: float) -> Tensor:
        """The observation that the learner acts on."""
        return observation

    def remembered(self, observation: Tensor, shown: Tensor) -> Tensor:
        """The observation that the replay buffer keeps, of the true one and the one that was acted on."""
        return shown

    def replayed(self, observation: Tensor, policy: Policy, share: float) -> Tensor:
        """The observation that a transition drawn from the replay buffer is learned with."""
        return observation

    def loss(self, policy: Policy, sample: TensorDictBase, own: Callable[[TensorDictBase], Tensor]) -> Tensor:
        """The loss of the policy on a batch of transitions; a critic always learns from the truth.

        Args:
            policy: being trained.
            sample: transitions [N] with `observation` (after `replayed`), `truth` (as remembered), `action` and `next`.
            own: the loss of the victim's algorithm on such a batch.
        """
        return own(sample)

    def selection(self, policy: Policy) -> dict[str, Callable[[Tensor], Tensor]]:
        """By name, further ways to show the observation when a checkpoint is scored; a checkpoint's score is the mean of all."""
        return {}


class DrivingAttack(Attack):
    """Changes what a driver measures. Batched over episodes.

    One without a memory writes `perturb` and nothing else. One that remembers something of every episode writes `initial` and
    `step`; the run keeps its state, so that the attack object itself stays as it is.
    """

    track: ClassVar[str] = "driving"
    action_types: ClassVar[tuple[ActionType, ...]] = ("discrete", "continuous")

    @classmethod
    def missing(cls) -> list[str]:
        neither = cls.perturb is DrivingAttack.perturb and cls.step is DrivingAttack.step
        return super().missing() + (["perturb or step"] if neither else [])

    def misfit(self, victim: DrivingVictim) -> str:
        if victim.action_type in self.action_types:
            return ""
        return f"whose actions are {victim.action_type}: it needs {' or '.join(self.action_types)} ones"

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        """What is remembered before the first step: a TensorDict of batch size [B], or None.

        Args:
            observation: the first true observation, [B, V, F].
            oracle: as of `perturb`; here it may be asked nothing.
        """
        return None

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor, State]:
        """What the victim is shown, as `perturb` returns it, and what is remembered from then on.

        Args:
            observation, oracle: as of `perturb`.
            state: of the same episodes, of batch size [B].
        """
        return self.perturb(observation, oracle), state

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        """The observation the victim is shown instead, [B, V, F]; of an attack without a memory.

        Args:
            observation: the true observation, float32 [B, V, F], of the episodes that are still running.
            oracle: the only door to the victim; it holds the perturbation set (`radius`, `project`), the query budget
                (`remaining`), and the run's random generator (`generator`).
        """
        raise NotImplementedError(f"{type(self).__name__} has neither perturb nor step")


class DrivingDefense(Defense):
    """Protects a driver."""

    track: ClassVar[str] = "driving"

    @abstractmethod
    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        """The defended policy, ready to drive: from the zoo, wrapped, or both.

        Args:
            victim: what is protected.
            seed: training seed.
            facts: of the world: features with units, ranges and resolutions, decision period, meaning of actions.
        """
