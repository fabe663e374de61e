"""How a driver learns, whatever its algorithm: two phases of practice, gradient updates, and checkpoints to choose from."""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torchrl.envs import EnvBase

from bench.driving import DrivingFacts, DrivingVictim, DrivingWorld, Policy, TrainingHooks
from bench.plugins.contracts import Progress, Trained
from bench.plugins.ranges import Count, Share
from bench.scenarios import SeedBlock
from bench.victims import zoo
from bench.victims.drivers.learner import CHUNK, Learner, Phase
from bench.victims.drivers.practice import Practice, roads
from bench.victims.drivers.selection import Best

WARM_UP = 40
"""Decisions taken before the first update."""


@dataclass(frozen=True, kw_only=True)
class LearningDriver(DrivingVictim):
    """What all trained drivers share.

    At 15 Hz single frames explore nothing, so a first phase holds each decision for `repeat` frames; but a lane change sent twice
    in a row crosses two lanes, so a second phase decides at every frame, as the scored policy does.

    Args:
        decisions: of the whole training, on every road at once.
        fine: share of them taken frame by frame, in the second phase.
        repeat: frames a decision is held in the first phase.
        hidden: width of the hidden layers behind the encoder.
        gamma: discount a decision of the first phase; a frame's share of it in the second.
        n_step: decisions in a return of the first phase; as many frames in the second.
        crash_penalty: reward of a crash or of leaving the road, in frames of perfect driving.
        learning_rate: of Adam; falls linearly to a twentieth over the second half; half of it where a trained policy goes on.
        batch: transitions an update.
        updates: gradient updates a decision of the whole batch of roads.
        copies: of each of the six roads, driven at once.
        memory: transitions in the replay buffer.
        tau: rate of the target networks' soft update.
        checkpoints: candidates for the final weights, spread over the last `fine` of the training.
        trained_in: parameters of the world it was trained in where they are not the default, for instance `vehicles=5`;
            `bench train` sets it.
    """

    learns: ClassVar[bool] = True
    policy_type: ClassVar[type[Policy]]

    decisions: Count = 36_000
    fine: Share = 0.45
    repeat: Count = 5
    hidden: Count = 128
    gamma: Share = 0.97
    n_step: Count = 3
    crash_penalty: float = 40.0
    learning_rate: float = 5e-4
    batch: Count = 512
    updates: Count = 1
    copies: Count = 24
    memory: Count = 600_000
    tau: Share = 0.005
    checkpoints: Count = 8
    trained_in: str = ""

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return zoo.load(zoo.Recipe.of(self), seed, self.policy_type)

    def phases(self, hooks: TrainingHooks) -> list[Phase]:
        """Held decisions first, then frame by frame; a policy that drives already goes on frame by frame. Whole chunks."""
        started = hooks.start is not None
        fine = hooks.decisions if started else round(self.decisions * self.fine)
        phases = [
            Phase(self.repeat, self.decisions - fine, self.gamma, self.n_step),
            # One frame of another action is worth a fifth of five: the gap keeps the size it had. An n-step return takes what
            # was done for what the policy would do, so it is short where that is wrong.
            Phase(
                1,
                fine,
                self.gamma ** (1 / self.repeat),
                self.repeat if hooks.off_policy else self.n_step * self.repeat,
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
        """Train on all roads of the standard grid at once, and keep the best checkpoint."""
        torch.manual_seed(seed)
        started = time.process_time()
        hooks = hooks or TrainingHooks()
        best, learner, done = Best(world, hooks, episodes=60), None, 0
        phases = self.phases(hooks)
        total = sum(phase.decisions for phase in phases)
        for number, phase in enumerate(phases):
            env = world.make(roads(world, self.copies), action_type=self.action_type, action_repeat=phase.repeat)
            env.set_seed(SeedBlock.TRAIN * (seed + 1) + number * SeedBlock.REPORT)
            learner = learner or self.learner(env, hooks)
            learner.enter(phase)
            recall = {"memory": self.memory, "batch": self.batch}
            practice = Practice(env, learner, phase, crash_penalty=self.crash_penalty, **recall)
            for taken in range(CHUNK, phase.decisions + 1, CHUNK):
                share = done / total
                practice.drive(CHUNK, share)
                done += CHUNK
                learner.anneal()
                if taken > WARM_UP:
                    rate = self.learning_rate * max(0.05, min(1.0 if hooks.start is None else 0.5, 2 * (1 - share)))
                    for _ in range(CHUNK * self.updates):
                        learner.update(practice.sample(share), rate)
                if phase.repeat == 1 and self._due(done / total, len(best.history), hooks):
                    best.offer(learner.averaged(), done / total)
                progress(done / total, f"safe_progress {best.score:.2f}" if best.history else "")
        assert learner is not None
        card = {**best.card(), "cpu_seconds": round(time.process_time() - started, 1)}
        return Trained(best.restore(learner.averaged()), card)

    def _due(self, share: float, offered: int, hooks: TrainingHooks) -> bool:
        """Whether another checkpoint is due; they are spread over the last `fine` of the training."""
        checkpoints = math.ceil(self.checkpoints * hooks.checkpoints)
        return share >= 1 - self.fine * (1 - (offered + 1) / checkpoints) - 1e-9
