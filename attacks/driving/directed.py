"""The base of attacks with a director: a learned preference among actions, and targeted PGD that induces them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

from annotated_types import Interval
from torch import Tensor

from cavbench.attacks.driving.director_training import AdversaryWorld, Director
from cavbench.attacks.driving.pgd import PGD
from cavbench.attacks.driving.targets import Controls, EveryAction, Targets
from cavbench.core.contracts import Access, Progress, Trained
from cavbench.core.ranges import Count, Width
from cavbench.driving import ActionType, DrivingAttack, Policy

if TYPE_CHECKING:
    from cavbench.driving import Oracle


@dataclass(frozen=True, kw_only=True)
class Directed(DrivingAttack):
    """At each step, induces the action with the highest value for the attacker that the perturbation set allows.

    The director is a Q-network over T targets. `perturb` descends towards all targets at once, `restarts` times each, and keeps
    the point at which the victim takes the target with the highest value of all points on the way.

    Args:
        steps: gradient steps per restart.
        restarts: independent starts per target.
        step_size: length of a step as a share of the radius.
        decisions: length of the training in decisions on every road.
        hidden: width of the director's hidden layers.
        steering: |steering| of the targets of a continuous victim.
        crash_bonus: reward for a crash or for leaving the road, in frames of perfect driving.
        trained_in: non-default parameters of the training world; set by `bench train`.
    """

    access: ClassVar[Access] = "gradients"
    needs: ClassVar[tuple[str, ...]] = ("x", "y", "vx", "vy")
    learns: ClassVar[bool] = True
    at_run_time: ClassVar[tuple[str, ...]] = ("steps", "restarts", "step_size")

    steps: Count = 8
    restarts: Count = 2
    step_size: Annotated[float, Interval(gt=0, le=2)] = 0.5
    decisions: Count = 1000
    hidden: Width = 128
    steering: Annotated[float, Interval(gt=0, le=1)] = 0.1
    crash_bonus: float = 200.0
    trained_in: str = ""

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        assert isinstance(self.adversary, Policy)
        if not len(observation) or int(oracle.remaining.min()) < 3:
            return observation
        values = self.adversary.scores(observation.float())
        menu = self.targets_now(observation, oracle, values.shape[-1])
        restarts, loss, key = menu.pursuit(values, self.restarts)
        return PGD(steps=self.steps, restarts=restarts, step_size=self.step_size).descend(
            observation, oracle, loss, key
        )

    def targets_now(self, observation: Tensor, oracle: Oracle, count: int) -> Targets:
        """The `count` targets in a step; may query the victim once."""
        return self.targets_of(oracle.action_type, count)

    def targets_of(self, action_type: ActionType, actions: int) -> Targets:
        """The target actions for a victim with so many discrete actions, or a continuous one."""
        return EveryAction(actions) if action_type == "discrete" else Controls(self.steering)

    def direct(self, world: AdversaryWorld, *, seed: int, progress: Progress) -> Trained[Policy]:
        """Train the director in its world."""
        director = Director(decisions=self.decisions, hidden=self.hidden, crash_penalty=self.crash_bonus)
        trained = director.train(world, seed=seed, progress=progress)
        return Trained(trained.network, {**trained.card, "director": asdict(director)})
