"""Adversarial training of a driving policy with a skip probability (thesis, Algorithm 5 and section 4.4.4)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Interval
from tensordict import TensorDictBase
from torch import Tensor

from cavbench import zoo
from cavbench.core.contracts import Progress, Trained
from cavbench.core.options import configured, parameter_words
from cavbench.core.ranges import Count, NotNegative, Share
from cavbench.driving import (
    DrivingAttack,
    DrivingDefense,
    DrivingFacts,
    DrivingVictim,
    DrivingWorld,
    ObservationThreat,
    Policy,
    State,
    TrainingHooks,
)
from cavbench.driving.access import Enforcer
from cavbench.driving.policy import rows_of
from cavbench.driving.threat import Norm
from cavbench.driving.victim import CountedPolicy
from cavbench.driving.victims.networks import ActorPolicy
from cavbench.errors import UserError

CHANGES_LANE = ("LANE_LEFT", "LANE_RIGHT")
"""The discrete actions from which the consistency target subtracts `margin`."""
TEMPERATURE = 0.5
"""Temperature of the decisions in the consistency loss, in standard deviations of the Q-values over the actions."""


@dataclass(frozen=True, kw_only=True)
class AdversarialTraining(DrivingDefense):
    """Trains the victim under attack (thesis Algorithm 5; principle of Madry et al. 2018).

    Each observation of the training is attacked, except with probability `skip`. `skip=1` is the control: the same training
    without an attack.

    Args:
        skip: probability that an observation is not attacked, in [0, 1].
        attack: any registered stateless attack on driving policies.
        attack_params: its parameters, as on the command line but separated by spaces.
        others: further attacks, separated by commas, each with its parameters: `zo, pgd objective=target target_action=4`. Each
            time one of all attacks is drawn, and checkpoints are selected under each of them.
        norm: perturbation set of the training attack, `relative` or `linf`.
        budget: size of this set after the ramp.
        start: `trained` continues from the victim of the same training seed, `scratch` trains a new one.
        decisions: length of the training with `start=trained`, on every road at once; `scratch` uses the victim's own length.
        consistency: weight of the consistency loss, which makes the decision under attack equal the decision of the start policy
            on the true observation (TRADES, Zhang et al. 2019); 0 is the thesis' algorithm. Not used with `scratch`.
        margin: amount subtracted from the start policy's lane-change values in the consistency target (a value of 1 is perfect
            driving forever). A wrong lane change of one frame may cause a crash, a delay of one frame costs nothing. An attack
            must cross this margin to cause a lane change. Discrete victims only.
        where: `acting` attacks the observations on which the learner acts, and stores them in the replay buffer, as in the
            thesis; `replay` attacks the observations drawn from the buffer, against the current policy; `both` does both.
        ramp_from: share of the training after which the budget starts to grow from 0.
        ramp_to: share of the training at which it reaches `budget`.
        trained_in: non-default parameters of the training world, for instance `vehicles=5`; set by `bench train`.
    """

    skip: Share = 0.3
    attack: str = "pgd"
    attack_params: str = "steps=1 step_size=1 temperature=1"
    others: str = ""
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
        others = [words.split()[0] for words in self.others.split(",") if words.strip()]
        attacks = "+".join(dict.fromkeys((self.attack, *others)))
        return f"{victim.zoo_name()}-advtrain-{attacks}-skip{self.skip:g}"

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        if victim.policy_type is None:
            raise UserError("adversarial training needs a victim that learns")
        return zoo.load(zoo.Recipe.of(victim, self), seed, victim.policy_type)

    def train(self, victim: DrivingVictim, world: DrivingWorld, *, seed: int, progress: Progress) -> Trained[Policy]:
        """Train the policy of training seed `seed`: the victim's own training with the attack in the loop.

        Raises:
            UserError: if the attack does not fit the victim, or `start=trained` and the zoo has no such victim.
        """
        others = [words.strip() for words in self.others.split(",") if words.strip()]
        attacks = [self._in_loop(words, victim) for words in (f"{self.attack} {self.attack_params}", *others)]
        start = victim.load(seed, world.facts) if self.start == "trained" else None
        loop = AttackInLoop(self, attacks, world.facts, start, seed)
        trained = victim.train(world, seed=seed, hooks=loop, progress=progress)
        of_attack = {"attack": asdict(attacks[0]), "attacked_decisions": loop.attacked}  # type: ignore[call-overload]
        return Trained(trained.network, {**trained.card, **of_attack, "threat": asdict(loop.threat)})

    @staticmethod
    def _in_loop(words: str, victim: DrivingVictim) -> DrivingAttack:
        """The attack in a text such as `pgd steps=2`, if it can be in the loop."""
        name, _, parameters = words.partition(" ")
        attack = configured("attack", name, parameter_words(parameters)).component
        if not isinstance(attack, DrivingAttack) or type(attack).perturb is DrivingAttack.perturb:
            raise UserError(f"adversarial training needs a stateless attack on driving policies, {name!r} is not one")
        if attack.learns:
            raise UserError(
                f"attack {name!r} needs a trained victim: adversarial training takes attacks that do not learn"
            )
        if misfit := attack.misfit(victim):
            raise UserError(f"attack {name!r} does not fit the victim, {misfit}")
        return attack


class AttackInLoop(TrainingHooks):
    """Algorithm 5: attack each observation, except with probability `skip`; and the loss under attack.

    Args:
        recipe: the defence.
        attacks: the training attacks.
        facts: facts of the world: features of the observation, names of the actions.
        start: the policy to continue from, also the teacher of the consistency loss; None trains from fresh weights.
        seed: training seed.
    """

    off_policy = True
    checkpoints = 0.5

    def __init__(
        self,
        recipe: AdversarialTraining,
        attacks: Sequence[DrivingAttack],
        facts: DrivingFacts,
        start: Policy | None,
        seed: int,
    ) -> None:
        self.recipe, self.attacks, self.facts = recipe, attacks, facts
        self.changes_lane = torch.tensor([float(action in CHANGES_LANE) for action in facts.actions])
        self.start, self.decisions = start, recipe.decisions
        self.threat = ObservationThreat(norm=recipe.norm, budget=recipe.budget)
        self.skips, self.noise = (torch.Generator().manual_seed(seed) for _ in range(2))
        self.attacked = 0

    def acting(self, observation: Tensor, policy: Policy, share: float, state: State = None) -> Tensor:
        return observation if self.recipe.where == "replay" else self.shown(observation, policy, share, state)

    def remembered(self, observation: Tensor, shown: Tensor) -> Tensor:
        return shown if self.recipe.where == "acting" else observation

    def replayed(self, observation: Tensor, policy: Policy, share: float) -> Tensor:
        return observation if self.recipe.where == "acting" else self.shown(observation, policy, share)

    def shown(self, observation: Tensor, policy: Policy, share: float, state: State = None) -> Tensor:
        """o' [B, V, F]: each of the B observations attacked with probability 1 - skip, with the current budget of the ramp."""
        recipe = self.recipe
        if recipe.skip >= 1 or share < recipe.ramp_from:
            return observation
        hit = torch.rand(observation.shape[0], generator=self.skips) >= recipe.skip
        if not bool(hit.any()):
            return observation
        scale = min(1.0, (share - recipe.ramp_from) / max(recipe.ramp_to - recipe.ramp_from, 1e-9))
        drawn = int(torch.randint(len(self.attacks), (1,), generator=self.skips)) if len(self.attacks) > 1 else 0
        result = observation.clone()
        result[hit] = self.perturbed(self.attacks[drawn], observation[hit], policy, rows_of(state, hit), scale)
        self.attacked += int(hit.sum())
        return result

    def perturbed(
        self, attack: DrivingAttack, observation: Tensor, policy: Policy, state: State = None, scale: float = 1.0
    ) -> Tensor:
        """attack(policy, o) [B, V, F], with a budget multiplied by `scale`."""
        enforcer = Enforcer(CountedPolicy(policy), self.threat, attack.access, self.facts.features, self.noise)
        return enforcer.project(attack.perturb(observation, enforcer.begin(observation, state, scale)))[0]

    def selection(self, policy: Policy) -> dict[str, Callable[[Tensor, State], Tensor]]:
        if self.recipe.skip >= 1:
            return {}
        names = ["attacked", *(f"attacked {number}" for number in range(1, len(self.attacks)))]
        return {
            name: lambda observation, state, attack=attack: self.perturbed(attack, observation, policy, state)  # type: ignore[misc]
            for name, attack in zip(names, self.attacks, strict=True)
        }

    def ranked(self, scores: Mapping[str, float]) -> float:
        """The mean of the score without an attack and of the lowest one under an attack."""
        attacked = [score for name, score in scores.items() if name != "clean"]
        return (scores["clean"] + min(attacked, default=scores["clean"])) / 2

    def loss(self, policy: Policy, sample: TensorDictBase, own: Callable[[TensorDictBase], Tensor]) -> Tensor:
        """Discrete: the victim's own loss on (o', a, r, s'). Continuous: -Q(o, mu(o')), with the critic on the true observation.

        The consistency loss is added. For continuous actions it is added on the true observation as well; otherwise the policy
        drives faster without attack than the start policy.
        """
        shown, truth = sample["observation"], sample["truth"]
        if policy.action_type == "discrete":
            return own(sample) + self.inconsistency(policy, shown, truth)
        misled = -policy.value(truth, policy.scores(shown)).mean()
        return misled + self.inconsistency(policy, shown, truth) + self.inconsistency(policy, truth, truth)

    def inconsistency(self, policy: Policy, shown: Tensor, truth: Tensor) -> Tensor | float:
        """The weighted consistency loss: decisions on `shown` compared with those of `start` on `truth`; 0 without `start`.

        The regulariser of TRADES (Zhang et al. 2019, Eq. 5) with a fixed teacher.
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
    """Mean KL divergence of the decisions softmax(Q / tau) from the target softmax((Q_0 - margin) / tau).

    Args:
        values: Q [N, A] of the policy in training.
        wanted: Q_0 [N, A]; tau is `TEMPERATURE` times its standard deviation over the actions.
        margin: [A], subtracted from `wanted`.
    """
    tau = TEMPERATURE * wanted.std(-1, keepdim=True).clamp(min=torch.finfo(wanted.dtype).tiny)
    decided = torch.log_softmax(values / tau, -1)
    target = torch.softmax((wanted - margin) / tau, -1)
    return torch.nn.functional.kl_div(decided, target, reduction="batchmean")


def squared_distance(actions: Tensor, wanted: Tensor, limit: Tensor) -> Tensor:
    """Mean squared distance of actions [N, 2] from `wanted`, in units of the largest action `limit` [2]."""
    return ((actions - wanted) / limit).square().sum(-1).mean()
