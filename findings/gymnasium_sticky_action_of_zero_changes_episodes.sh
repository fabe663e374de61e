#!/usr/bin/env bash
# One guesses: StickyAction(env, 0.0) never repeats an action, so it changes nothing: it is the clean run beside runs of 0.1 and 0.25.
# What happens: it draws from the generator of the environment at every step but the first, whatever the probability. From the second step on
# the environment draws other numbers. Of runs with one seed, that of 0 is other episodes than that without the wrapper.
# For whom it matters: a drop from "no wrapper" to 0.1 is partly other episodes. The run of 0 in the wrapper is the one to compare with.
# Versions: gymnasium 1.4.0 (wrappers/stateful_action.py, StickyAction.action; `np_random` of a wrapper is that of its environment).
# SuperSuit's sticky_actions_v0 has a generator of its own. Source: a robustness curve that began with probability 0.
source "$(dirname "$0")/fresh.sh"
fresh gymnasium==1.4.0 SuperSuit==3.11.0 pettingzoo==1.27.0 numpy
see <<'P'
import gymnasium
import supersuit
from gymnasium.wrappers import StickyAction


def slides(wrapper):
    """Places of ten episodes on the ice."""
    found = []
    for seed in range(10):
        env = wrapper(gymnasium.make("FrozenLake-v1", map_name="8x8"))
        places, ended = [env.reset(seed=seed)[0]], False
        while not ended:
            place, _, terminated, truncated, _ = env.step(1)
            places.append(int(place))
            ended = terminated or truncated
        found.append(places)
    return found


bare = slides(lambda env: env)
assert bare == slides(lambda env: env)
seen = {
    "gymnasium": slides(lambda env: StickyAction(env, 0.0)),
    "SuperSuit": slides(lambda env: supersuit.sticky_actions_v0(env, 0.0)),
}
other = {name: sum(a != b for a, b in zip(bare, found, strict=True)) for name, found in seen.items()}
same = all(a[:2] == b[:2] for a, b in zip(bare, seen["gymnasium"], strict=True))
print(f"gymnasium {gymnasium.__version__}, sticky actions of probability 0: of 10 episodes so many are other ones: {other}; first step equal: {same}")
raise SystemExit(not (other["gymnasium"] >= 8 and other["SuperSuit"] == 0 and same))
P
