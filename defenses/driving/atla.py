"""Alternating training of a recurrent policy with a learned adversary."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Annotated

import torch
from annotated_types import Interval
from torch import Tensor

from cavbench import zoo
from cavbench.core.contracts import Progress, Trained
from cavbench.core.ranges import Count, NotNegative, Positive, Share, Width
from cavbench.defenses.driving.adversary import Adversary
from cavbench.defenses.driving.alternating import Alternation, RecurrentPractice, Turn, Updates
from cavbench.defenses.driving.recurrent import RecurrentPolicy
from cavbench.driving import (
    DrivingDefense,
    DrivingFacts,
    DrivingVictim,
    DrivingWorld,
    ObservationThreat,
    Policy,
    State,
    TrainingHooks,
)
from cavbench.driving.threat import Norm
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.learner import CHUNK, Phase
from cavbench.driving.victims.networks import QPolicy
from cavbench.driving.victims.practice import roads
from cavbench.driving.victims.selection import Best
from cavbench.errors import UserError
from cavbench.scenarios import SeedBlock


@dataclass(frozen=True, kw_only=True)
class AlternatingTraining(DrivingDefense):
    """Trains a policy with a memory and an adversary in turns (ATLA, Zhang et al. 2021, arXiv 2101.08452, Algorithm 1).

    In the adversary's turn the policy is frozen and the adversary learns to minimise the reward; in the policy's turn the
    adversary is frozen and the policy sees what it shows. Both learn by PPO. The policy continues from the `dqn` of the same
    training seed: the memory has no weight at first. `budget=0` is the control: the same training without an adversary.

    Args:
        alternations: number of turns of the policy; before each, and after the last, the adversary has a turn.
        decisions: length of a turn of the policy, on every road at once.
        adversary_decisions: length of a turn of the adversary.
        norm: perturbation set of the adversary, `relative` or `linf`.
        budget: size of this set after the ramp.
        ramp_to: share of the alternations after which the budget, which grows from 0, is `budget`.
        guide: weight of the expected value of the start's Q-function on the true observation, which the policy raises and the
            adversary lowers besides the objective of PPO; 0 is the paper's.
        memory: size of the policy's memory.
        temperature: Q-values of the start are divided by it to be the first logits; a value of 1 is perfect driving forever.
        learning_rate: of the policy (Adam); it falls linearly to a twentieth over the second half.
        adversary_rate: of the adversary, likewise.
        rollout: decisions on every road between two rounds of updates; gradients go back through the memory to the first.
        epochs: how often each decision is learned from.
        parts: number of minibatches of whole sequences in an epoch.
        clip: epsilon of PPO.
        entropy: weight of the policy's entropy bonus.
        trace: lambda of the advantages per decision.
        adversary_hidden: width of the adversary's hidden layers.
        trained_in: non-default parameters of the training world, for instance `vehicles=5`; set by `bench train`.
    """

    alternations: Count = 12
    decisions: Count = 320
    adversary_decisions: Count = 192
    norm: Norm = "relative"
    budget: Annotated[float, Interval(ge=0, le=2)] = 0.1
    ramp_to: Annotated[float, Interval(gt=0, le=1)] = 0.4
    guide: NotNegative = 1.0
    memory: Width = 64
    temperature: Positive = 0.01
    learning_rate: Positive = 3e-4
    adversary_rate: Positive = 2e-3
    rollout: Annotated[int, Interval(ge=8)] = 32
    epochs: Count = 2
    parts: Count = 6
    clip: Annotated[float, Interval(gt=0, lt=1)] = 0.3
    entropy: NotNegative = 0.01
    trace: Share = 0.97
    adversary_hidden: Width = 32
    trained_in: str = ""

    def zoo_name(self, victim: DrivingVictim) -> str:
        return f"{victim.zoo_name()}-atla"

    @property
    def updates(self) -> Updates:
        """How both learn."""
        return Updates(**{field.name: getattr(self, field.name) for field in fields(Updates)})

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        return zoo.load(zoo.Recipe.of(_dqn(victim), self), seed, RecurrentPolicy)

    def train(self, victim: DrivingVictim, world: DrivingWorld, *, seed: int, progress: Progress) -> Trained[Policy]:
        """Train on all roads of the world's default grid at once, and keep the best checkpoint.

        A checkpoint is a policy and the adversary that was trained against it afterwards.

        Raises:
            UserError: if the victim is not a DQN, or the zoo has none of this training seed.
        """
        dqn, started = _dqn(victim), time.process_time()
        torch.manual_seed(seed)
        start = dqn.load(seed, world.facts)
        assert isinstance(start, QPolicy)
        threat = ObservationThreat(norm=self.norm, budget=self.budget)
        policy = RecurrentPolicy.continuing(start, self.memory, self.temperature)
        adversary = Adversary(start.shape["features"], self.adversary_hidden, threat, world.facts.features)
        learner = Alternation(policy, adversary, start, self.updates)
        env = world.make(roads(world, dqn.copies), action_type="discrete")
        env.set_seed(SeedBlock.TRAIN * (seed + 1))
        phase = Phase(1, self.decisions, dqn.gamma ** (1 / dqn.repeat))
        learner.enter(phase)
        practice = RecurrentPractice(env, learner, phase, crash_penalty=dqn.crash_penalty)
        scored = Scored(adversary)
        best = Best(world, scored, dqn.selection_episodes)

        def play(turn: Turn, decisions: int, share: float) -> None:
            learner.begin(turn)
            for _ in range(math.ceil(decisions / CHUNK)):
                practice.drive(CHUNK, share)
                learner.learn(max(0.05, min(1.0, 2 * (1 - share))), share)

        for alternation in range(self.alternations + 1):
            share = alternation / self.alternations
            adversary.scale = min(1.0, share / self.ramp_to)
            play("adversary", self.adversary_decisions, share)
            best.offer(learner.averaged(), share)
            progress(share, f"safe_progress {scored.latest:.2f}")
            if alternation < self.alternations:
                play("policy", self.decisions, share)
        card = {**best.card(), "selection_history": scored.curve, "threat": asdict(threat)}
        seconds = round(time.process_time() - started, 1)
        return Trained(best.restore(policy), {**card, "cpu_seconds": seconds})


def _dqn(victim: DrivingVictim) -> DQN:
    if not isinstance(victim, DQN):
        raise UserError(f"atla continues from a dqn, and {type(victim).__name__} is none: use victim=dqn")
    if victim.behind:
        raise UserError(f"atla trains no driver behind {victim.behind!r}: leave victim.behind out")
    return victim


class Scored(TrainingHooks):
    """Scores checkpoints clean and under the adversary, with the budget of the moment.

    Args:
        adversary: the adversary.

    `curve` has the scores of all checkpoints, with the budget as a share of the last one (`scale`).
    """

    def __init__(self, adversary: Adversary) -> None:
        self.adversary = adversary
        self.curve: list[dict[str, float]] = []
        self.latest = 0.0

    def selection(self, policy: Policy) -> dict[str, Callable[[Tensor, State], Tensor]]:
        if self.adversary.threat.budget == 0:
            return {}
        return {"attacked": lambda observation, state: self.adversary.shown(observation)}

    def ranked(self, scores: Mapping[str, float]) -> float:
        """The mean of the scores; checkpoints with a smaller budget come after all others."""
        self.latest = sum(scores.values()) / len(scores)
        self.curve.append(
            {"scale": round(self.adversary.scale, 3), **{name: round(one, 4) for name, one in scores.items()}}
        )
        return self.latest if self.adversary.scale == 1 else self.latest - 1
