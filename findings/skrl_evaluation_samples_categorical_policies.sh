#!/usr/bin/env bash
# One guesses: trainer.eval() of skrl with stochastic_evaluation=False evaluates the policy without sampling.
# What happens: it uses the `mean_actions` of the model's outputs, if there are any. A categorical policy has none, so its sampled actions are
# taken, with no word. Two evaluations of one policy from one seed of the environment differ.
# Versions: skrl 2.1.1, torch 2.13.0, gymnasium 1.2.2. Source: met while comparing policies with their exports.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 skrl==2.1.1 gymnasium==1.2.2 numpy
see <<'P'
import contextlib
import io

import gymnasium
import numpy as np
import skrl
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import CategoricalMixin, DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer

skrl.logger.setLevel("ERROR")


class Still(gymnasium.Env):
    """Notes the actions."""

    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, action_space):
        self.action_space, self.taken = action_space, []

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.taken.append(float(np.asarray(action).reshape(-1)[0]))
        return np.zeros(2, np.float32), 0.0, False, False, {}


def model(mixin, outputs):
    class Made(mixin, Model):
        def __init__(self, env):
            Model.__init__(self, observation_space=env.observation_space, action_space=env.action_space, device="cpu")
            mixin.__init__(self)
            self.bias = torch.nn.Parameter(torch.zeros(outputs))

        def compute(self, inputs, role):
            found = self.bias.expand(len(inputs["observations"]), -1)
            return found, {"log_std": torch.zeros_like(found)} if mixin is GaussianMixin else {}

    return Made


seen = {}
for name, mixin, outputs, space in (
    ("categorical", CategoricalMixin, 4, gymnasium.spaces.Discrete(4)),
    ("gaussian", GaussianMixin, 1, gymnasium.spaces.Box(-1, 1, (1,), np.float32)),
):
    inner = Still(space)
    env = wrap_env(inner, wrapper="gymnasium", verbose=False)
    config = PPO_CFG()
    config.experiment.write_interval = config.experiment.checkpoint_interval = 0
    models = {"policy": model(mixin, outputs)(env), "value": model(DeterministicMixin, 1)(env)}
    agent = PPO(
        models=models, memory=RandomMemory(memory_size=8, num_envs=1, device="cpu"), cfg=config,
        observation_space=env.observation_space, action_space=env.action_space, device="cpu",
    )
    settings = {"timesteps": 200, "headless": True, "disable_progressbar": True, "stochastic_evaluation": False}
    with contextlib.redirect_stdout(io.StringIO()):
        SequentialTrainer(cfg=settings, env=env, agents=agent).eval()
    seen[name] = len(set(inner.taken))
print(f"skrl {skrl.__version__}, one observation 200 times, stochastic_evaluation=False: different actions {seen}")
raise SystemExit(seen != {"categorical": 4, "gaussian": 1})
P
