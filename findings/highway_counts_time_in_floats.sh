#!/usr/bin/env bash
# One guesses: an episode of 30 s has 450 decisions at 15 a second, 150 at 5 and 90 at 3.
# What happens: it has 451, 151 and 91, since 1/15 is added up as a float and the end is asked for by "at least". At 10 and 1 a second it has 300
# and 30.
# Versions: highway-env 1.12.1. Source: episodes of a road without other cars.
source "$(dirname "$0")/fresh.sh"
fresh highway-env==1.12.1 gymnasium==1.4.0 numpy==2.4.6
see <<'P'
from importlib.metadata import version

import gymnasium
import highway_env

gymnasium.register_envs(highway_env)


def decisions(rate):
    config = {"duration": 30, "policy_frequency": rate, "simulation_frequency": rate * max(1, 15 // rate), "vehicles_count": 0}
    env = gymnasium.make("highway-fast-v0", config=config)
    env.reset(seed=0)
    count, ended = 0, False
    while not ended:
        _, _, terminated, truncated, _ = env.step(1)
        count, ended = count + 1, terminated or truncated
    return count


seen = {rate: decisions(rate) for rate in (15, 10, 5, 3, 1)}
print(f"highway-env {version('highway-env')}: decisions in 30 s, by how many a second: {seen}")
raise SystemExit(seen != {15: 451, 10: 300, 5: 151, 3: 91, 1: 30})
P
