"""The base classes of the driving track: World, Policy, Victim, Attack and Defense of a driver on a highway."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
from torch import Tensor, nn

from bench.plugins.contracts import Attack, Defense, Progress, Track, Trained, Victim, World

if TYPE_CHECKING:
    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase

    from bench.driving.threat import Oracle
    from bench.scenarios.grid import Cell

ActionType = Literal["discrete", "continuous"]
Driver = Literal["agent", "idm"]


@dataclass(frozen=True)
class Features:
    """The measured features of an observation row, in order, with the range that maps to [-1, 1].

    An observation is a float tensor [B, V, F]: V vehicles (row 0 is the ego, absolute; the rest relative to it, nearest
    first, all zero where absent), F = 1 + len(names): `presence` in {0, 1}, then each measured feature over its range.
    """

    names: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    units: tuple[str, ...]

    def half_range(self) -> Tensor:
        """[F - 1] physical units that one unit of the normalised observation stands for."""
        return (torch.tensor(self.high) - torch.tensor(self.low)) / 2


class DrivingWorld(World):
    """Makes TorchRL environments for the cells of a grid.

    The environments are batched ([B] episodes), take an explicit scenario seed an episode in the reset tensordict (`seed`,
    int64 [B]; without it seeds are drawn from `set_seed`), and write under `("next", ...)`:
    `observation` float32 [B, V, F]; `reward` float32 [B, 1]; `done`, `terminated`, `truncated` bool [B, 1]; and `info`, the
    ground truth that scoring reads and no policy or attack may: `progress` (Eq. 4.1 without its offset, over 0.5, in [0, 1]),
    `speed` m/s, `x` m, `ttc` s (time to collision with the car ahead in the ego's lane, inf if none), each float32 [B, 1],
    `crashed` and `offroad` bool [B, 1].
    """

    track: ClassVar[Track] = "driving"
    features: ClassVar[Features]
    max_steps: int

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
            driver: `idm` lets highway-env's own IDM/MOBIL driver steer the ego and ignores the actions.
            action_repeat: frames a decision is held (training only): lane changes are sent once, the rest is repeated;
                reward and progress are summed over the frames, an episode stops where it ends.
        """


class Policy(nn.Module, ABC):
    """A victim at the wheel: a differentiable map from observations to scores, and from scores to an action."""

    action_type: ActionType
    driver: Driver = "agent"
    weights_sha256: str = ""
    """Hash of the weights file it was loaded from; empty where there is none."""

    @abstractmethod
    def scores(self, observation: Tensor) -> Tensor:
        """What a score-based attacker reads: Q-values [..., A] (discrete) or the action itself [..., 2] (continuous).

        Args:
            observation: float [..., V, F].
        """

    def decide(self, observation: Tensor) -> Tensor:
        """The action taken: int64 [...] (discrete, the greedy one) or float [..., 2] in [-1, 1] (continuous)."""
        return self.choose(self.scores(observation))

    def choose(self, scores: Tensor) -> Tensor:
        """The action that goes with scores; without a side effect, so that measurements may ask what would have been done."""
        return scores.argmax(-1) if self.action_type == "discrete" else scores

    def value(self, observation: Tensor, action: Tensor) -> Tensor:
        """Q(observation, action) [...], differentiable in both; for white-box attacks on continuous actions.

        Raises:
            NotImplementedError: if the victim has no critic.
        """
        raise NotImplementedError(f"{type(self).__name__} has no critic")

    def reset(self, seeds: Tensor) -> None:
        """Called before an episode batch with its scenario seeds [B]; for policies with a state or their own randomness."""

    def forward(self, observation: Tensor) -> Tensor:
        return self.decide(observation)


class DrivingVictim(Victim):
    """A kind of driver; fields are its hyper-parameters."""

    track: ClassVar[Track] = "driving"
    sees: ClassVar[bool] = True
    """False for drivers that ignore the observation: attacks and weather cannot touch them."""
    policy_type: ClassVar[type[Policy] | None] = None
    """The class of its trained policies, which the zoo builds from a card."""

    @property
    @abstractmethod
    def action_type(self) -> ActionType:
        """Whether it takes discrete lane-changing decisions or steers itself."""

    @abstractmethod
    def load(self, seed: int) -> Policy:
        """The policy of training seed `seed`, in eval mode, without gradients on its weights.

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
    """Changes what a driver measures. Batched over episodes; stateless between steps."""

    track: ClassVar[Track] = "driving"
    action_types: ClassVar[tuple[ActionType, ...]] = ("discrete", "continuous")

    @abstractmethod
    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        """The observation the victim is shown instead, [B, V, F].

        Args:
            observation: the true observation, float32 [B, V, F], of the episodes that are still running.
            oracle: the only door to the victim; it holds the perturbation set (`radius`, `project`), the query budget
                (`remaining`), and the run's random generator (`generator`).
        """


class DrivingDefense(Defense):
    """Protects a driver."""

    track: ClassVar[Track] = "driving"

    @abstractmethod
    def load(self, victim: DrivingVictim, seed: int) -> Policy:
        """The defended policy, ready to drive: from the zoo, wrapped, or both."""
