#!/usr/bin/env bash
# One guesses: the seed of an EnvPool environment fixes its scenario, and other seeds give other ones, as in highway-env.
# What happens: Highway-v0, HighwayFast-v0, Merge-v0 and Parking-v0 follow the seed. Roundabout-v0, Intersection-v0, Exit-v0, TwoWay-v0, UTurn-v0,
# LaneKeeping-v0 and the racetracks begin with one and the same scenario for all seeds, so an average over seeds is an average over one.
# Versions: envpool 1.2.5 (in 1.2.7 not tried). Source: a comparison of EnvPool's tasks with highway-env's.
source "$(dirname "$0")/fresh.sh"
fresh envpool==1.2.5 numpy
see <<'P'
from importlib.metadata import version

import envpool
import numpy as np

SAME = "Roundabout-v0", "Intersection-v0", "Exit-v0", "TwoWay-v0", "UTurn-v0", "LaneKeeping-v0", "Racetrack-v0"
OTHERS = "Highway-v0", "Merge-v0"


def begun(task, seed):
    """What is seen after a few steps that do nothing."""
    env = envpool.make(task, env_type="gymnasium", num_envs=1, seed=seed)
    env.reset()
    for _ in range(3):
        seen, *_ = env.step(np.array([env.action_space.sample() * 0]))
    parts = seen.values() if isinstance(seen, dict) else [seen]
    return np.concatenate([np.asarray(part, float).ravel() for part in parts])


seen = {task: len({begun(task, seed).tobytes() for seed in range(6)}) for task in (*SAME, *OTHERS)}
print(f"envpool {version('envpool')}, different scenarios of 6 seeds: {seen}")
raise SystemExit(not (all(seen[task] == 1 for task in SAME) and all(seen[task] == 6 for task in OTHERS)))
P
