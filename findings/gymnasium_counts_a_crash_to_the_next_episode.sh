#!/usr/bin/env bash
# One guesses: NormalizeReward divides by the deviation of the discounted return of an episode, in every vector mode, as SB3's VecNormalize does.
# What happens: the return is set to zero before the reward of a crash is added, so that reward opens the return of the next episode; a time
# limit ends no return. The default mode, NEXT_STEP, and the wrapper of one environment do so. SAME_STEP counts as Stable-Baselines3 does.
# For whom it matters: a penalty for crashes of -10 arrives as -14 in one mode and -3.3 in the other, so the same training learns other drivers.
# Versions: gymnasium 1.4.0 (wrappers/stateful_reward.py and wrappers/vector/stateful_reward.py, NormalizeReward.step), stable-baselines3 2.9.2.
# That time limits do not end it is told in its issues 760 and 1507. Source: comparing the statistics of two libraries in their vector modes.
source "$(dirname "$0")/fresh.sh"
fresh gymnasium==1.4.0 stable-baselines3==2.9.2 torch==2.13.0 numpy
see <<'P'
import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import NormalizeReward
from gymnasium.wrappers.vector import NormalizeReward as VectorNormalizeReward
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

EPISODES, STEPS = 200, 10


class Drive(gymnasium.Env):
    """Episodes of ten steps that end in a crash or by the time limit."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, reward, last, crash):
        self.reward, self.last, self.crash = reward, last, crash

    def reset(self, *, seed=None, options=None):
        self.step_of_episode = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.step_of_episode += 1
        end = self.step_of_episode == STEPS
        return np.zeros(1, np.float32), self.last if end else self.reward, end and self.crash, end and not self.crash, {}


def deviations(*rewards):
    """The deviation that rewards are divided by, for each wrapper."""

    def make():
        return Drive(*rewards)

    single = NormalizeReward(make())
    for _ in range(EPISODES):
        single.reset()
        for _ in range(STEPS):
            single.step(0)
    found = {"one": single.return_rms.var}
    for mode in AutoresetMode:
        env = VectorNormalizeReward(SyncVectorEnv([make], autoreset_mode=mode))
        env.reset()
        for _ in range(EPISODES * (STEPS + (mode == AutoresetMode.NEXT_STEP))):
            _, _, terminated, truncated, _ = env.step(np.zeros(1, int))
            if mode == AutoresetMode.DISABLED and (terminated | truncated).any():
                env.reset(options={"reset_mask": terminated | truncated})
        found[mode.name] = env.return_rms.var
    other = VecNormalize(DummyVecEnv([make]), norm_obs=False)
    other.reset()
    for _ in range(EPISODES * STEPS):
        other.step(np.zeros(1, int))
    found["SB3"] = other.ret_rms.var
    return {name: round(float(np.sqrt(variance)), 2) for name, variance in found.items()}


crash, limit = deviations(0.0, -10.0, True), deviations(1.0, 1.0, False)
print(f"gymnasium {gymnasium.__version__}: rewards are divided by, crash of -10 after 9 steps of 0: {crash}; ten steps of 1, then the time limit: {limit}")
raise SystemExit(
    crash != {"one": 0.7, "NEXT_STEP": 0.7, "SAME_STEP": 3.0, "DISABLED": 3.0, "SB3": 3.0}
    or limit != {"one": 14.89, "NEXT_STEP": 14.89, "SAME_STEP": 2.73, "DISABLED": 2.73, "SB3": 2.73}
)
P
