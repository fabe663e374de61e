#!/usr/bin/env bash
# One guesses: "merge-v0 is out of date, consider upgrading to v1" means the same task without its faults.
# What happens: v1 is another class (ConnectedLaneMergeEnv). A car that asks for SLOWER at every decision crashes in 1 of 20 scenarios of v0, and in 7 of
# the same 20 seeds of v1. Figures of v0 and v1 cannot be compared. (intersection-v1 has continuous actions, v0 and v2 have three discrete ones.)
# Versions: highway-env 1.12.1. Source: the warning of gymnasium.make.
source "$(dirname "$0")/fresh.sh"
fresh highway-env==1.12.1 gymnasium==1.4.0 numpy==2.4.6
see <<'P'
from importlib.metadata import version

import gymnasium
import highway_env

gymnasium.register_envs(highway_env)
SLOWER = 4


def crashes(task):
    env, count = gymnasium.make(task), 0
    for seed in range(20):
        env.reset(seed=seed)
        ended = False
        while not ended:
            _, _, terminated, truncated, info = env.step(SLOWER)
            ended = terminated or truncated
        count += info["crashed"]
    return count


seen = {task: crashes(task) for task in ("merge-v0", "merge-v1")}
actions = {task: str(gymnasium.make(task).action_space) for task in ("intersection-v0", "intersection-v1", "intersection-v2")}
print(f"highway-env {version('highway-env')}: crashes of 20 who ask for SLOWER {seen}, actions {actions}")
kinds = [text.split("(")[0] for text in actions.values()]
raise SystemExit(seen != {"merge-v0": 1, "merge-v1": 7} or kinds != ["Discrete", "Box", "Discrete"])
P
