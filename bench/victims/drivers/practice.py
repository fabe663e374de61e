"""Practice: the roads a learner drives on, its reward, and the replay buffer of n-step transitions."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, ExplorationType, MultiStepTransform, set_exploration_type

from bench.driving import DrivingWorld
from bench.plugins import registry
from bench.scenarios import Cell
from bench.victims.drivers.learner import Learner, Phase


def roads(world: DrivingWorld, copies: int) -> list[Cell]:
    """The roads of a world's own grid, `copies` of each: one batch practises on all of them.

    Perceptual axes are at their first value: it practises in clear weather.
    """
    cells = dict.fromkeys(world.axes.unperceived(cell) for cell in registry.grid(world.grid).cells())
    return [cell for cell in cells for _ in range(copies)]


class Practice:
    """Drives the roads in one phase of the training and remembers n-step transitions.

    The reward is Eq. 4.1 of the thesis without highway-env's normalisation, over 0.5, with a failure at -`crash_penalty`; the
    mean over the frames a decision is held, times (1 - gamma), so that values stay in one range. (On the normalised reward a
    car that only brakes earns 0.70 of the maximum, and learners stay there.)

    Args:
        env: one episode a road, decisions held for `phase.repeat` frames.
        learner: takes the decisions.
        phase: of the training.
        crash_penalty: reward of a crash or of leaving the road, in frames of perfect driving.
        memory: transitions in the replay buffer.
        batch: transitions in a sample.
    """

    def __init__(
        self, env: EnvBase, learner: Learner, phase: Phase, *, crash_penalty: float, memory: int, batch: int
    ) -> None:
        self.env, self.learner, self.phase, self.crash_penalty = env, learner, phase, crash_penalty
        self.buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(memory), batch_size=batch)
        # Without done_keys=[] the transform keeps the first step's `terminated` and bootstraps through crashes.
        self.multi_step = MultiStepTransform(n_steps=phase.n_step, gamma=phase.gamma, done_keys=[])
        self.td = env.reset()

    @torch.no_grad()
    def drive(self, decisions: int, share: float) -> None:
        """Take `decisions` on every road; `share` of the training is done."""
        hooks, policy = self.learner.hooks, self.learner.policy
        chunk = []
        for _ in range(decisions):
            truth = self.td["observation"]
            shown = hooks.acting(truth, policy, share)
            self.td.set("observation", shown)
            with set_exploration_type(ExplorationType.RANDOM):
                self.learner.explore(self.td)
            self.td.set("observation", hooks.remembered(truth, shown))
            step, self.td = self.env.step_and_maybe_reset(self.td)
            chunk.append(self._transition(step))
        transitions = self.multi_step.inv(torch.stack(chunk, -1))
        if transitions is not None and transitions.numel():
            self.buffer.extend(transitions.exclude("gamma", "nonterminal", ("next", "original_reward")).reshape(-1))

    def sample(self, share: float) -> TensorDictBase:
        """A batch of transitions: `truth` is the observation that was remembered, `observation` what is learned with."""
        sample = self.buffer.sample()
        truth = sample["observation"]
        sample.set("truth", truth)
        return sample.set("observation", self.learner.hooks.replayed(truth, self.learner.policy, share))

    def _transition(self, step: TensorDictBase) -> TensorDict:
        after, phase = step["next"], self.phase
        failed = after["info", "crashed"] | after["info", "offroad"]
        reward = after["info", "progress"] - self.crash_penalty * failed.float()
        after = after.select("observation", "terminated", "done")
        after.set("reward", reward * ((1 - phase.gamma) / phase.repeat))
        return TensorDict(
            {"observation": step["observation"], "action": step["action"], "next": after}, batch_size=step.batch_size
        )
