"""The training of driving policies for any algorithm: two phases, gradient updates and checkpoint selection."""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import torch
from torchrl.envs import EnvBase

from cavbench import zoo
from cavbench.core.contracts import Progress, Trained
from cavbench.core.ranges import Count, Share, Width
from cavbench.driving import DrivingFacts, DrivingVictim, DrivingWorld, Policy, TrainingHooks
from cavbench.driving.victims.attack_mix import AttackMix
from cavbench.driving.victims.behind import Guard, GuardedPractice, defense_of
from cavbench.driving.victims.learner import CHUNK, Learner, Phase
from cavbench.driving.victims.practice import Practice, roads
from cavbench.driving.victims.selection import Best
from cavbench.scenarios import SeedBlock

WARM_UP = 40
"""Decisions before the first update."""


@dataclass(frozen=True, kw_only=True)
class LearningDriver(DrivingVictim):
    """The base class of all trained driving policies.

    Deciding at every frame (15 Hz) explores too little, so the first phase holds each decision for `repeat` frames. But a lane
    change sent twice in a row crosses two lanes, so the second phase decides at every frame, like the scored policy.

    Args:
        decisions: number of decisions in the training, on every road at once.
        fine: share of the decisions in the second phase, which decides at every frame.
        repeat: number of frames for which a decision is held in the first phase.
        hidden: width of the hidden layers after the encoder.
        gamma: discount per decision in the first phase; gamma^(1/repeat) in the second.
        crash_penalty: cost of a crash or of leaving the road, in frames of perfect driving.
        learning_rate: initial rate of Adam; it falls linearly to a twentieth over the second half. With a trained start it is
            half of this.
        batch: transitions per update.
        copies: number of parallel episodes on each road of the grid.
        checkpoints: number of candidates for the final weights, spread over the last share `fine` of the training.
        trained_in: non-default parameters of the training world, for instance `vehicles=5`; set by `bench train`.
        behind: the defence that it is trained behind, with its parameters, for instance `tracker+shield shield.band=6`; empty for
            none. It only says which weights are meant; `defense` says what it drives behind.
        behind_decisions: length of the training behind the defence, which continues from the weights without one.
    """

    learns: ClassVar[bool] = True
    algorithm: ClassVar[str]
    """The name of its entries in the zoo."""
    policy_type: ClassVar[type[Policy]]
    sign: ClassVar[float] = 1.0
    """-1 for an adversary: its reward is minus the driver's, and its best checkpoint has the lowest `safe_progress`."""
    selection_episodes: ClassVar[int] = 60
    """Episodes per road for which a checkpoint is scored."""

    decisions: Count = 36_000
    fine: Share = 0.45
    repeat: Count = 5
    hidden: Width = 128
    gamma: Share = 0.97
    crash_penalty: float = 40.0
    learning_rate: float = 5e-4
    batch: Count = 512
    copies: Count = 24
    checkpoints: Count = 8
    trained_in: str = ""
    behind: str = ""
    behind_decisions: Count = 4_000

    def zoo_name(self) -> str:
        return f"{self.algorithm}-behind-{self.behind.split()[0]}" if self.behind.strip() else self.algorithm

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return zoo.load(zoo.Recipe.of(self), seed, self.policy_type)

    def phases(self, hooks: TrainingHooks) -> list[Phase]:
        """The phases in whole chunks: decisions held for `repeat` frames, then for one; a trained start has only the second."""
        started = hooks.start is not None
        fine = hooks.decisions if started else round(self.decisions * self.fine)
        phases = [
            Phase(self.repeat, self.decisions - fine, self.gamma),
            # One frame of another action changes the value a fifth as much as five frames: `gap` restores the action gap.
            Phase(
                1,
                fine,
                self.gamma ** (1 / self.repeat),
                exploration=1 / self.repeat,
                gap=1 - 1 / self.repeat,
            ),
        ]
        whole = [replace(phase, decisions=max(1, round(phase.decisions / CHUNK)) * CHUNK) for phase in phases]
        return whole[1:] if started else whole

    @abstractmethod
    def learner(self, env: EnvBase, hooks: TrainingHooks) -> Learner:
        """The algorithm on `env`, from fresh weights or from `hooks.start`."""

    def train(
        self, world: DrivingWorld, *, seed: int, hooks: TrainingHooks | None = None, progress: Progress
    ) -> Trained[Policy]:
        """Train on all roads of the world's default grid at once, and keep the best checkpoint."""
        torch.manual_seed(seed)
        started = time.process_time()
        guard = Guard(defense_of(self.behind), self, world.facts) if self.behind else None
        if guard is not None and hooks is None:
            start = replace(self, behind="", behind_decisions=type(self).behind_decisions).load(seed, world.facts)
            hooks = AttackMix(start, self.behind_decisions, world.facts, seed)
        hooks = hooks or TrainingHooks()
        best, learner, done = Best(world, hooks, self.selection_episodes, self.sign), None, 0
        if guard is not None:
            best.defended = guard.around
        phases = self.phases(hooks)
        total = sum(phase.decisions for phase in phases)
        for number, phase in enumerate(phases):
            env = world.make(roads(world, self.copies), action_type=self.action_type, action_repeat=phase.repeat)
            env.set_seed(SeedBlock.TRAIN * (seed + 1) + number * SeedBlock.REPORT)
            learner = learner or self.learner(env, hooks)
            learner.enter(phase)
            practiced = Practice if guard is None else partial(GuardedPractice, guard=guard)
            practice = practiced(env, learner, phase, crash_penalty=self.crash_penalty, sign=self.sign)
            for taken in range(CHUNK, phase.decisions + 1, CHUNK):
                share = done / total
                practice.drive(CHUNK, share)
                done += CHUNK
                learner.anneal()
                if taken > WARM_UP:
                    rate = self.learning_rate * max(0.05, min(1.0 if hooks.start is None else 0.5, 2 * (1 - share)))
                    learner.learn(rate, share)
                if self._due(done / total, len(best.history), hooks):
                    best.offer(learner.averaged(), done / total)
                progress(done / total, f"safe_progress {best.score:.2f}" if best.score is not None else "")
        assert learner is not None
        card = {**best.card(), "cpu_seconds": round(time.process_time() - started, 1)}
        return Trained(best.restore(learner.averaged()), card)

    def _due(self, share: float, offered: int, hooks: TrainingHooks) -> bool:
        """Whether another checkpoint is due; they are spread over the last `fine` of the training."""
        checkpoints = math.ceil(self.checkpoints * hooks.checkpoints)
        return share >= 1 - self.fine * (1 - (offered + 1) / checkpoints) - 1e-9
