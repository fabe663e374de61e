"""Adversarial training with a skip probability (thesis, Algorithm 5 and section 4.4.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Interval
from tensordict import TensorDictBase
from torch import Tensor

from bench.driving import (
    DrivingAttack,
    DrivingDefense,
    DrivingFacts,
    DrivingVictim,
    DrivingWorld,
    ObservationThreat,
    Oracle,
    Policy,
    TrainingHooks,
)
from bench.driving.threat import Norm
from bench.errors import UserError
from bench.plugins.contracts import Progress, Trained
from bench.plugins.options import configured, parameter_words
from bench.plugins.ranges import Count, NotNegative, Share
from bench.victims import zoo
from bench.victims.drivers.networks import ActorPolicy

CHANGES_LANE = ("LANE_LEFT", "LANE_RIGHT")
"""The discrete actions that consistency asks for with reluctance."""
TEMPERATURE = 0.5
"""Of the decisions that consistency compares, in standard deviations of the Q-values over the actions."""


@dataclass(frozen=True, kw_only=True)
class AdversarialTraining(DrivingDefense):
    """The victim learns while it is attacked (thesis Algorithm 5; Madry et al. 2018 for the principle).

    Each decision of the training is attacked, except that with probability `skip` the victim sees the truth. `skip=1` is the
    control: the same training without an attack.

    Args:
        skip: probability that a decision is not attacked, in [0, 1].
        attack: any registered attack.
        attack_params: its parameters, as on the command line but separated by spaces.
        norm: perturbation set of the attack in the loop, `relative` or `linf`.
        budget: size of that set once the ramp is over.
        start: `trained` goes on from the victim of the same training seed, `scratch` trains a new one.
        decisions: of the further training, on every road at once; with `scratch` it is the victim's own.
        consistency: weight, beside the victim's own loss, of deciding under attack what the victim it started from decides on
            the truth (TRADES, Zhang et al. 2019); 0 is the thesis' algorithm. Nothing to be consistent with from `scratch`.
        margin: subtracted from the lane-change values of that policy (1 is perfect driving for ever) in the consistency target.
            A wrong lane change of one frame may be a crash, a delay of one frame costs nothing: an attack has to cross the
            margin between the two. Discrete victims only.
        where: `acting` attacks the observations it acts on, which the replay buffer keeps as they were then, as in the thesis;
            `replay` attacks those drawn from the buffer, afresh against the policy as it is now; `both` does both.
        ramp_from: share of the training after which the budget begins to grow from 0.
        ramp_to: share of the training at which it is whole.
        trained_in: parameters of the world it was trained in where they are not the default, for instance `vehicles=5`;
            `bench train` sets it.
    """

    skip: Share = 0.3
    attack: str = "pgd"
    attack_params: str = "steps=1 step_size=1 temperature=1"
    norm: Norm = "relative"
    budget: Annotated[float, Interval(ge=0, le=2)] = 0.1
    start: Literal["trained", "scratch"] = "trained"
    decisions: Count = 8_000
    consistency: NotNegative = 0.4
    margin: NotNegative = 0.02
    where: Literal["acting", "replay", "both"] = "both"
    ramp_from: Share = 0.0
    ramp_to: Share = 0.3
    trained_in: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ramp_from > self.ramp_to:
            raise ValueError(f"ramp_from must be at most ramp_to, got {self.ramp_from} and {self.ramp_to}")

    def zoo_name(self, victim: DrivingVictim) -> str:
        return f"{victim.zoo_name()}-advtrain-{self.attack}-skip{self.skip:g}"

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        if victim.policy_type is None:
            raise UserError("adversarial training needs a victim that learns")
        return zoo.load(zoo.Recipe.of(victim, self), seed, victim.policy_type)

    def train(self, victim: DrivingVictim, world: DrivingWorld, *, seed: int, progress: Progress) -> Trained[Policy]:
        """Train the hardened policy of training seed `seed`: the victim's own training with the attack in its loop.

        Raises:
            UserError: if the attack does not fit the victim, or `start=trained` and the zoo has no such victim.
        """
        attack = configured("attack", self.attack, parameter_words(self.attack_params)).component
        if not isinstance(attack, DrivingAttack) or type(attack).perturb is DrivingAttack.perturb:
            raise UserError(
                f"adversarial training needs an attack on drivers without a memory, {self.attack!r} is none"
            )
        if misfit := attack.misfit(victim):
            raise UserError(f"attack {self.attack!r} does not fit the victim, {misfit}")
        start = victim.load(seed, world.facts) if self.start == "trained" else None
        loop = AttackInLoop(self, attack, world.facts, start, seed)
        trained = victim.train(world, seed=seed, hooks=loop, progress=progress)
        of_attack = {"attack": asdict(attack), "attacked_decisions": loop.attacked}  # type: ignore[call-overload]
        return Trained(trained.network, {**trained.card, **of_attack, "threat": asdict(loop.threat)})


class AttackInLoop(TrainingHooks):
    """Algorithm 5: each decision is attacked, except that it is skipped with probability `skip`; and the loss under attack.

    Args:
        recipe: the defence.
        attack: in the loop.
        facts: of the world: features of the observation, names of the actions.
        start: the policy to continue from and to stay consistent with; None trains from fresh weights.
        seed: training seed.
    """

    off_policy = True
    checkpoints = 0.5

    def __init__(
        self, recipe: AdversarialTraining, attack: DrivingAttack, facts: DrivingFacts, start: Policy | None, seed: int
    ) -> None:
        self.recipe, self.attack, self.facts = recipe, attack, facts
        self.changes_lane = torch.tensor([float(action in CHANGES_LANE) for action in facts.actions])
        self.start, self.decisions = start, recipe.decisions
        self.threat = ObservationThreat(norm=recipe.norm, budget=recipe.budget)
        self.skips, self.noise = (torch.Generator().manual_seed(seed) for _ in range(2))
        self.attacked = 0

    def acting(self, observation: Tensor, policy: Policy, share: float) -> Tensor:
        return observation if self.recipe.where == "replay" else self.shown(observation, policy, share)

    def remembered(self, observation: Tensor, shown: Tensor) -> Tensor:
        return shown if self.recipe.where == "acting" else observation

    def replayed(self, observation: Tensor, policy: Policy, share: float) -> Tensor:
        return observation if self.recipe.where == "acting" else self.shown(observation, policy, share)

    def shown(self, observation: Tensor, policy: Policy, share: float) -> Tensor:
        """o' [B, V, F]: each row of the observation attacked with probability 1 - skip, at the budget of the ramp."""
        recipe = self.recipe
        if recipe.skip >= 1 or share < recipe.ramp_from:
            return observation
        hit = torch.rand(observation.shape[0], generator=self.skips) >= recipe.skip
        if not bool(hit.any()):
            return observation
        scale = min(1.0, (share - recipe.ramp_from) / max(recipe.ramp_to - recipe.ramp_from, 1e-9))
        result = observation.clone()
        result[hit] = self.perturbed(observation[hit], policy, scale)
        self.attacked += int(hit.sum())
        return result

    def perturbed(self, observation: Tensor, policy: Policy, scale: float = 1.0) -> Tensor:
        """attack(policy, o) [B, V, F], within `scale` times the budget."""
        oracle = Oracle(policy, self.threat, self.attack.access, self.facts.features, self.noise)
        oracle.begin_step(observation, scale=scale)
        return oracle.project(self.attack.perturb(observation, oracle)).detach()

    def selection(self, policy: Policy) -> dict[str, Callable[[Tensor], Tensor]]:
        return {"attacked": lambda observation: self.perturbed(observation, policy)} if self.recipe.skip < 1 else {}

    def loss(self, policy: Policy, sample: TensorDictBase, own: Callable[[TensorDictBase], Tensor]) -> Tensor:
        """Discrete: the victim's own loss on (o', a, r, s'). Continuous: -Q(o, mu(o')), judged by a critic that knows the truth.

        Consistency is added. For continuous actions it is asked for on the truth as well: asked for under attack alone, the
        policy drives faster on the truth than the one it started from.
        """
        shown, truth = sample["observation"], sample["truth"]
        if policy.action_type == "discrete":
            return own(sample) + self.inconsistency(policy, shown, truth)
        misled = -policy.value(truth, policy.scores(shown)).mean()
        return misled + self.inconsistency(policy, shown, truth) + self.inconsistency(policy, truth, truth)

    def inconsistency(self, policy: Policy, shown: Tensor, truth: Tensor) -> Tensor | float:
        """How far the decisions on `shown` are from those of `start` on `truth`, times the weight; 0 without a `start`.

        The regulariser of TRADES (Zhang et al. 2019, Eq. 5), with a teacher that stays as it is.
        """
        if self.start is None or self.recipe.consistency == 0:
            return 0.0
        with torch.no_grad():
            wanted = self.start.scores(truth)
        if policy.action_type == "discrete":
            margin = self.recipe.margin * self.changes_lane
            return self.recipe.consistency * divergence(policy.scores(shown), wanted, margin)
        limit = policy.actor.limit if isinstance(policy, ActorPolicy) else torch.ones(2)
        return self.recipe.consistency * squared_distance(policy.scores(shown), wanted, limit)


def divergence(values: Tensor, wanted: Tensor, margin: Tensor) -> Tensor:
    """Mean KL divergence of the decisions softmax(Q / tau) from those wanted, softmax((Q_0 - margin) / tau).

    Args:
        values: Q [N, A] of the policy that is trained.
        wanted: Q_0 [N, A]; tau is `TEMPERATURE` times its standard deviation over the actions.
        margin: [A], subtracted from `wanted`.
    """
    tau = TEMPERATURE * wanted.std(-1, keepdim=True).clamp(min=torch.finfo(wanted.dtype).tiny)
    decided = torch.log_softmax(values / tau, -1)
    reluctant = torch.softmax((wanted - margin) / tau, -1)
    return torch.nn.functional.kl_div(decided, reluctant, reduction="batchmean")


def squared_distance(actions: Tensor, wanted: Tensor, limit: Tensor) -> Tensor:
    """Mean squared distance of actions [N, 2] from those wanted, in shares of the largest action [2]."""
    return ((actions - wanted) / limit).square().sum(-1).mean()
