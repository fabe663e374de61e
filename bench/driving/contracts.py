"""The base classes of the driving track: world, victim, attack, defence, and the training hooks of a defence."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

from torch import Tensor

from cavbench.core.contracts import Attack, Defense, Progress, ThreatModel, Trained, Victim, World
from cavbench.core.parameters import differing
from cavbench.driving.access import Oracle
from cavbench.driving.blame import Deeds
from cavbench.driving.dynamics import Dynamics
from cavbench.driving.features import ActionType, Control, Driver, DrivingFacts, Features
from cavbench.driving.forgery import Forgery
from cavbench.driving.kinematics import Kinematics
from cavbench.driving.policy import Policy, State
from cavbench.driving.sets import Traffic
from cavbench.driving.surroundings import USUAL, Surroundings
from cavbench.driving.threat import ObservationThreat
from cavbench.scenarios import Cell

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase


class DrivingWorld(World):
    """Makes TorchRL environments for the cells of a grid.

    The environments are batched ([B] episodes). The reset tensordict holds a scenario seed for each episode (`seed`, int64 [B];
    without it, seeds are drawn from `set_seed`). They write under `("next", ...)`:
    `observation` float32 [B, V, F]; `reward` float32 [B, 1]; `done`, `terminated`, `truncated` bool [B, 1]; and `info`, the
    ground truth for scoring, which policies and attacks may not read: `progress` (thesis Eq. 4.1 without its offset, divided by
    0.5, in [0, 1]; in the step that ends an episode by arriving, that of the steps that are left, too), `speed` in m/s, `x` in
    m, `ttc` in s (time to collision with the car ahead in the ego's lane, inf if there
    is none), each float32 [B, 1]; `crashed` and `offroad`, bool [B, 1].
    """

    track: ClassVar[str] = "driving"
    name: ClassVar[str]
    """Its name on the command line and in `cavbench.gym.make`. Only `gym_call` needs it."""
    features: ClassVar[Features]
    actions: ClassVar[tuple[str, ...]]
    """Names of the discrete actions, by number."""
    max_steps: int
    """Number of decisions in an episode that is not terminated early."""
    drivers: ClassVar[tuple[Driver, ...]] = ("agent",)
    """The values of `driver` that `make` supports."""
    offers: ClassVar[tuple[str, ...]] = ("presence", "latency", "held", "actuator")
    """Names of the sets of a threat model that it can carry out. With `traffic` its environments give what an attacker that
    drives cars sees, `traffic` float64 [B, N, 7] (`cavbench.driving.traffic.View`), and take `orders` float64 [B, N, 3]."""
    brakes_by: ClassVar[str] = "give world.target_speeds a lower first speed"
    """What a user does so that SLOWER ends at a lower speed."""

    @property
    @abstractmethod
    def decision_hz(self) -> float:
        """Decisions per second."""

    @property
    def kinematics(self) -> Kinematics | None:
        """How the world's cars move, for policies that predict their own motion; None if the world does not say."""
        return None

    @property
    def observed_rows(self) -> int | None:
        """V, the number of rows in its observations [B, V, F]; None if the world does not say.

        Policies from files are checked against it before anything is driven.
        """
        return None

    @property
    def facts(self) -> DrivingFacts:
        return DrivingFacts(
            axes=self.axes,
            decision_hz=self.decision_hz,
            max_steps=self.max_steps,
            actions=self.actions,
            features=self.features,
            drivers=self.drivers,
            kinematics=self.kinematics,
            rows=self.observed_rows,
        )

    @property
    def gym_call(self) -> str:
        """What makes a gymnasium environment of it, as a user types it."""
        options = "".join(f", {name}={value!r}" for name, value in differing(self).items())
        return f'cavbench.gym.make("{self.name}"{options})'

    def facts_at(self, cell: Cell) -> DrivingFacts:
        """The facts in a cell, where they depend on it. Cells with different facts are driven in different batches."""
        return self.facts

    @abstractmethod
    def build(self, cells: Sequence[Cell], control: Control) -> EnvBase:
        """An environment with len(cells) episodes; episode b is on cells[b].

        Args:
            cells: the cell of each episode of the batch.
            control: how the car is driven.
        """

    def make(
        self,
        cells: Sequence[Cell],
        *,
        action_type: ActionType = "discrete",
        driver: Driver = "agent",
        action_repeat: int = 1,
        traffic: Traffic | None = None,
        surroundings: Surroundings = USUAL,
    ) -> EnvBase:
        """The environment of `build`; the other arguments are those of `cavbench.driving.Control`."""
        return self.build(
            cells,
            Control(
                action_type=action_type,
                driver=driver,
                action_repeat=action_repeat,
                traffic=traffic,
                surroundings=surroundings,
            ),
        )

    def blame(
        self,
        cells: Sequence[Cell],
        control: Control,
        deeds: Deeds,
        decisions: NDArray[np.int64],
        crashed: NDArray[np.bool_],
    ) -> Mapping[str, NDArray[np.float64]]:
        """Who is to blame for the crashes of episodes in which an attacker drove cars of the traffic.

        Args:
            cells, control: of the B episodes, as in `build`.
            deeds: what was done in them.
            decisions: decisions of each episode [B].
            crashed: whether it ended in a crash [B].

        Returns:
            The measurements of `cavbench.driving.blame`, [B] each; nothing from a world that cannot say.
        """
        return {}

    def dynamics(self, cells: Sequence[Cell], action_type: ActionType) -> Dynamics | None:
        """The rules of motion, for attacks with access `dynamics`; None if the world does not offer them.

        They must not depend on the hidden state of an episode.

        Args:
            cells: the cell of each episode of the batch.
            action_type: kind of the actions in a plan.
        """
        return None


class DrivingVictim(Victim):
    """A kind of driving policy; the fields are its hyper-parameters."""

    track: ClassVar[str] = "driving"
    network: ClassVar[type[Policy]] = Policy
    threat: ClassVar[type[ThreatModel]] = ObservationThreat
    driver: ClassVar[Driver] = "agent"
    """Who is at the wheel; its policies must have the same. Only a victim that does not see may leave it to the world."""
    policy_type: ClassVar[type[Policy] | None] = None
    """The class of its trained policies; the zoo builds it from a card."""
    made_for: ClassVar[str] = ""
    """Name of the world that it is checked in, if it is of no use in the usual one."""
    brakes_to: ClassVar[float | None] = None
    """The target speed in m/s that SLOWER must be able to end at; None if it needs none. A run warns where it cannot."""

    @property
    @abstractmethod
    def action_type(self) -> ActionType:
        """Whether it takes discrete lane-changing decisions or outputs continuous acceleration and steering."""

    @property
    def draws(self) -> bool:
        """Whether its policies may draw from the random generators of the process when they answer.

        That is measured and flagged. One that comes from outside may not, because nobody could repeat its score.
        """
        return True

    @abstractmethod
    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        """The policy of training seed `seed`, in eval mode, without gradients on its weights.

        Args:
            seed: training seed.
            facts: facts of the world in which it will drive.

        Raises:
            cavbench.errors.UserError: if the zoo has no such policy; the message has the command that trains it.
        """

    def train(
        self, world: DrivingWorld, *, seed: int, hooks: TrainingHooks | None = None, progress: Progress
    ) -> Trained[Policy]:
        """Train from fresh weights (or from `hooks.start`), with the changes of a defence's hooks."""
        raise NotImplementedError(f"{type(self).__name__} does not learn")


class TrainingHooks:
    """The changes that a defence may make to the training of a driving policy; the defaults change nothing.

    Observations are [B, V, F], `share` is the finished share of the training, in [0, 1], and `policy` is the network in
    training: its `scores` have gradients to the weights, its `value` is a copy of the critic. Where it acts it is behind the
    defence that it is trained behind, if any, and `state` is its state.
    """

    start: Policy | None = None
    """The trained policy to continue from, without action repeat; None trains from fresh weights."""
    decisions: int = 0
    """Length of the training on every road, used with a `start`."""
    off_policy: bool = False
    """Whether many actions differ from the policy's own choice; n-step returns then stay short."""
    checkpoints: float = 1.0
    """Share of the victim's checkpoints that are scored, in (0, 1]; for hooks with expensive scoring."""

    def acting(self, observation: Tensor, policy: Policy, share: float, state: State = None) -> Tensor:
        """The observation on which the learner acts."""
        return observation

    def remembered(self, observation: Tensor, shown: Tensor) -> Tensor:
        """The observation for the replay buffer, from the true one and the one the learner acted on (`shown`)."""
        return shown

    def replayed(self, observation: Tensor, policy: Policy, share: float) -> Tensor:
        """The observation to learn from, for a transition drawn from the replay buffer."""
        return observation

    def loss(self, policy: Policy, sample: TensorDictBase, own: Callable[[TensorDictBase], Tensor]) -> Tensor:
        """The loss of the policy on a batch of transitions: a number, or [N]; a critic always learns from the truth.

        Args:
            policy: the policy in training.
            sample: transitions [N] with `observation` (after `replayed`), `truth` (after `remembered`), `action` and `next`.
            own: the loss [N] of the victim's algorithm on each transition of such a batch.
        """
        return own(sample)

    @property
    def learns_otherwise(self) -> bool:
        """Whether it changes what is learned from a transition. If not, the update may be compiled."""
        return any(getattr(type(self), name) is not getattr(TrainingHooks, name) for name in ("replayed", "loss"))

    def selection(self, policy: Policy) -> dict[str, Callable[[Tensor, State], Tensor]]:
        """Additional perturbations of the observation for scoring a checkpoint, by name; arguments: observation and state."""
        return {}

    def ranked(self, scores: Mapping[str, float]) -> float:
        """The score of a checkpoint, from its scores without a perturbation (`clean`) and with those of `selection`."""
        return sum(scores.values()) / len(scores)


class DrivingAttack(Attack):
    """Perturbs the observation of a driving policy. Batched over episodes.

    A stateless attack implements only `perturb`. An attack with a state for each episode implements `initial` and `step`; the
    run keeps the state, and the attack object does not change.
    """

    track: ClassVar[str] = "driving"
    action_types: ClassVar[tuple[ActionType, ...]] = ("discrete", "continuous")
    joint: ClassVar[bool] = False
    """Whether one call may attack the episodes of several units. Such an attack draws the random numbers of each unit from the
    unit's own generator (`Oracle.parts`), and nothing else that it does for a unit depends on the others. A subclass says it
    for itself."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Names of the features without which it can do nothing."""
    made_for: ClassVar[str] = ""
    """Name of the world that it is checked in, if it is of no use in the usual one."""
    drives: ClassVar[bool] = False
    """Whether it drives cars of the traffic (`Oracle.order`); the threat model must allow it some (`threat.traffic.cars`)."""

    @property
    def forges(self) -> tuple[str, ...]:
        return ("traffic.cars=1",) if self.drives else ()

    def lacks(self, world: DrivingWorld) -> str:
        if self.drives and "traffic" not in world.offers:
            return "it drives cars of the traffic, which this world does not allow"
        if self.access == "dynamics" and type(world).dynamics is DrivingWorld.dynamics:
            return "it needs the dynamics of the world (how its cars move), which this world does not offer"
        return missing_features(self.needs, world)

    @classmethod
    def missing(cls) -> list[str]:
        neither = cls.perturb is DrivingAttack.perturb and cls.step is DrivingAttack.step
        return super().missing() + (["perturb or step"] if neither else [])

    def misfit(self, victim: DrivingVictim) -> str:
        if victim.action_type in self.action_types:
            return ""
        return f"whose actions are {victim.action_type}: it needs {' or '.join(self.action_types)} ones"

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        """The state before the first step: a TensorDict of batch size [B], or None.

        Args:
            observation: the first true observation, [B, V, F].
            oracle: as in `perturb`, but queries are not allowed here.
        """
        return None

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor | Forgery, State]:
        """The observation for the victim, as in `perturb`, or a `Forgery`; and the state for the next step.

        Args:
            observation, oracle: as in `perturb`.
            state: the state of the same episodes, batch size [B].
        """
        return self.perturb(observation, oracle), state

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor | Forgery:
        """The perturbed observation for the victim, [B, V, F], from a stateless attack.

        Args:
            observation: the true observation, float32 [B, V, F], of the episodes that are still running.
            oracle: the only access to the victim; it holds the perturbation set (`radius`, `project`), the query budget
                (`remaining`), and the run's random generator (`generator`).
        """
        raise NotImplementedError(f"{type(self).__name__} implements neither perturb nor step")


class DrivingDefense(Defense):
    """Protects a driving policy."""

    track: ClassVar[str] = "driving"
    brakes_to: ClassVar[float | None] = None
    """As `DrivingVictim.brakes_to`."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Names of the features without which it can do nothing."""
    reckons: ClassVar[bool] = False
    """Whether it needs to know how the world's cars move (`DrivingFacts.kinematics`)."""

    def lacks(self, world: DrivingWorld) -> str:
        if self.reckons and world.kinematics is None:
            return "it needs to know how the world's cars move (kinematics), which this world does not say"
        return missing_features(self.needs, world)

    @abstractmethod
    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        """The defended policy, ready to drive: loaded from the zoo, wrapped, or both.

        Args:
            victim: the victim to protect.
            seed: training seed.
            facts: facts of the world: features with units, ranges and resolutions, decision period, meaning of actions.
        """


NAMED = 6
"""So many features are named in a message."""


def missing_features(needed: Sequence[str], world: DrivingWorld) -> str:
    """That a world does not measure what is needed, as a sentence; empty if it does."""
    names = world.features.names
    if set(needed) <= set(names):
        return ""
    listed = ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
    return f"it needs the features {', '.join(needed)} of each car in a row of its own, this world measures {listed}"
