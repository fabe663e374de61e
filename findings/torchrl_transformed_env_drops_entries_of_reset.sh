#!/usr/bin/env bash
# One guesses: TransformedEnv(env).reset(tensordict) passes the tensordict on, so what env reads from it still counts.
# What happens: entries that are in no spec of its state are dropped without a word. An environment that reads a scenario number there is
# reset to another scenario as soon as it has a transform.
# Versions: torch 2.13.0, torchrl 0.14.1. Source: met while comparing rollouts of one policy with and without transforms.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 torchrl==0.14.1 tensordict==0.14.3 numpy
see <<'P'
import torch
import torchrl
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, StepCounter, TransformedEnv


class Numbered(EnvBase):
    """Its observation is the number of the scenario: the one that is asked for, or -1."""

    def __init__(self, declared=False):
        super().__init__(batch_size=[])
        self.observation_spec = Composite(observation=Unbounded((1,)))
        self.action_spec, self.reward_spec = Unbounded((1,)), Unbounded((1,))
        if declared:
            self.state_spec = Composite(scenario=Unbounded((1,)))

    def _reset(self, tensordict=None, **options):
        asked = None if tensordict is None else tensordict.get("scenario", None)
        return TensorDict({"observation": torch.full((1,), -1.0) if asked is None else asked, "done": torch.zeros(1, dtype=torch.bool)}, [])

    def _step(self, tensordict):
        raise NotImplementedError

    def _set_seed(self, seed):
        pass


asked = TensorDict({"scenario": torch.tensor([7.0])}, [])
plain = Numbered().reset(asked.clone())["observation"].item()
behind = TransformedEnv(Numbered(), StepCounter()).reset(asked.clone())["observation"].item()
declared = TransformedEnv(Numbered(declared=True), StepCounter()).reset(asked.clone())["observation"].item()
print(f"torchrl {torchrl.__version__}: scenario 7 is {plain:g} alone, {behind:g} behind a StepCounter, {declared:g} if it is declared as state")
raise SystemExit(not (plain == 7 and behind == -1 and declared == 7))
P
