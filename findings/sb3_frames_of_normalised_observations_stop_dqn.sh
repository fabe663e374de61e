#!/usr/bin/env bash
# One guesses: what trains PPO trains DQN. VecFrameStack(VecNormalize(env)) is an ordinary chain of wrappers of Stable-Baselines3.
# What happens: PPO trains. DQN (SAC, TD3 and DDPG, too) raises at its first step: its buffer is given the single observation from before
# VecNormalize in the place of the stack. In the other order both train.
# Versions: stable-baselines3 2.9.2, gymnasium 1.4.0, torch 2.13.0. Source: met while rebuilding such policies from their files.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 stable-baselines3==2.9.2 gymnasium==1.4.0 numpy
see <<'P'
import gymnasium
import stable_baselines3
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

orders = {
    "VecFrameStack(VecNormalize)": lambda env: VecFrameStack(VecNormalize(env), 3),
    "VecNormalize(VecFrameStack)": lambda env: VecNormalize(VecFrameStack(env, 3)),
}
seen = {}
for order, wrap in orders.items():
    for kind, options in ((PPO, {"n_steps": 8, "batch_size": 8}), (DQN, {"learning_starts": 4, "buffer_size": 50})):
        env = wrap(DummyVecEnv([lambda: gymnasium.make("CartPole-v1")]))
        try:
            kind("MlpPolicy", env, seed=0, device="cpu", **options).learn(16)
            seen[kind.__name__, order] = "trains"
        except ValueError as error:
            seen[kind.__name__, order] = f"ValueError: {error}"
print(f"stable-baselines3 {stable_baselines3.__version__}:", "; ".join(f"{k} {o}: {v}" for (k, o), v in seen.items()))
right = [key for key, value in seen.items() if value == "trains"]
raise SystemExit(not (len(right) == 3 and ("DQN", "VecFrameStack(VecNormalize)") not in right))
P
