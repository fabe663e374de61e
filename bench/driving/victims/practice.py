"""Collects the training experience: the roads and the reward."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from cavbench.core import registry
from cavbench.driving import DrivingWorld
from cavbench.driving.victims.learner import Learner, Phase
from cavbench.scenarios import Cell

ALLOWED = "allowed"
"""The key of the actions that a defence leaves to the policy behind it."""


def roads(world: DrivingWorld, copies: int) -> list[Cell]:
    """The training cells of a world: its default grid, `copies` of each cell.

    Perceptual axes have their first value: training is in clear weather.
    """
    cells = dict.fromkeys(world.axes.unperceived(cell) for cell in registry.grid_of(world).cells())
    return [cell for cell in cells for _ in range(copies)]


class Practice:
    """Drives the roads in one phase of the training, for the learner to collect.

    The reward is Eq. 4.1 of the thesis without highway-env's normalisation, divided by 0.5, minus `crash_penalty` on a failure.
    It is the mean over the frames of a decision, times (1 - gamma), which keeps the values in one range. (With the normalised
    reward, a car that only brakes earns 0.70 of the maximum, and training stops at this policy.)

    Args:
        env: one episode per road; decisions are held for `phase.repeat` frames.
        learner: makes the decisions.
        phase: the phase of the training.
        crash_penalty: cost of a crash or of leaving the road, in frames of perfect driving.
        sign: 1 for a driver; -1 for an adversary, whose reward is minus the driver's.
    """

    def __init__(
        self,
        env: EnvBase,
        learner: Learner,
        phase: Phase,
        *,
        crash_penalty: float,
        sign: float = 1.0,
    ) -> None:
        self.env, self.learner, self.phase, self.crash_penalty = env, learner, phase, crash_penalty
        self.sign = sign
        self.td = env.reset()

    @torch.no_grad()
    def drive(self, decisions: int, share: float) -> None:
        """Make `decisions` decisions on every road; `share` of the training is finished."""
        self.learner.collect(torch.stack([self.decide(share) for _ in range(decisions)], -1))

    def decide(self, share: float) -> TensorDict:
        """One decision on every road: the transitions [B]."""
        hooks, truth = self.learner.hooks, self.td["observation"]
        shown = hooks.acting(truth, self.learner.policy, share)
        self.td.set("observation", shown)
        self.explore()
        self.td.set("observation", hooks.remembered(truth, shown))
        step, self.td = self.env.step_and_maybe_reset(self.td)
        return self.transition(step)

    def explore(self) -> None:
        """The learner's actions for the observations in `td`, with exploration."""
        with set_exploration_type(ExplorationType.RANDOM):
            self.learner.explore(self.td)

    def transition(self, step: TensorDictBase) -> TensorDict:
        """The transitions [B] with their rewards, from a step of the environment."""
        after, phase = step["next"], self.phase
        failed = after["info", "crashed"] | after["info", "offroad"]
        reward = self.sign * (self.learner.progress(after["info"]) - self.crash_penalty * failed.float())
        after = after.select("observation", ALLOWED, "terminated", "done", strict=False)
        after.set("reward", reward * ((1 - phase.gamma) / phase.repeat))
        before = step.select("observation", ALLOWED, "action", "action_log_prob", strict=False)
        return TensorDict({**before, "next": after}, batch_size=step.batch_size)
