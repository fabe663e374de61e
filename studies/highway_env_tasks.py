"""highway-env's tasks in cavbench and in highway-env itself, side by side: every step of whole episodes.

    python studies/highway_env_tasks.py parity highway-fast-v0 200
    python studies/highway_env_tasks.py parity highway-v0 200

    python studies/highway_env_tasks.py train highway-fast-v0 dqn 4000 dqn.zip
    python studies/highway_env_tasks.py policy highway-fast-v0 dqn.zip 100

`parity`: both are started from the same seeds, 1,000,000 and on, and get the same actions. It prints how many steps were
compared, and how many differ.

`train`: a model of Stable-Baselines3, `dqn` or `ppo`, is trained in highway-env for so many steps. The settings are those of
highway-env's `scripts/sb3_highway_dqn.py` and `sb3_highway_ppo.py`, with one environment instead of six for PPO, and `seed=0`.

`policy`: the episodes of a model of Stable-Baselines3 under its own `evaluate_policy` in highway-env, one a seed, and the records
of `cavbench.score` of the same file. It prints how many episodes have another return or another crash, and which actions the
policy took.

NumPy's AVX-512 kernels are turned off, because with them highway-env differs from
itself in the last bit (docs/worlds/highway.md).
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy._core._multiarray_umath import __cpu_dispatch__ as numpy_kernels  # type: ignore[attr-defined]
from numpy.typing import NDArray
from tensordict import TensorDict

import cavbench

FIRST = 1_000_000
ACTIONS = ((0, 1, 2, 3, 4), (1, 1, 2, 4), (4, 4, 4, 4, 0, 2))
"""What the ego does at random, in turn from seed to seed: anything, little, and mostly braking, which drives to the end."""

ROUNDING = 1e-5
"""Stable-Baselines3 adds rewards up as float32. A return below 64 is then off by less than this; one other step is not."""


def without_avx512() -> None:
    """Begin this process again, with a numpy that rounds like scalar code."""
    if "NPY_DISABLE_CPU_FEATURES" not in os.environ:
        wide = [name for name in numpy_kernels if "AVX512" in name or name == "X86_V4"]
        os.environ |= {"NPY_DISABLE_CPU_FEATURES": " ".join(wide), "OPENBLAS_CORETYPE": "Haswell"}
        os.execv(sys.executable, [sys.executable, *sys.argv])


def planned(seeds: int, steps: int) -> NDArray[np.int64]:
    """The actions [T, B] of every episode."""
    generator = np.random.default_rng(0)
    return np.stack([generator.choice(ACTIONS[seed % len(ACTIONS)], steps) for seed in range(seeds)], 1)


def ours(task: str, actions: NDArray[np.int64], cell: dict[str, object]) -> dict[str, NDArray[np.generic]]:
    """What cavbench shows at every step, in one batch: arrays [T + 1, B, ...]."""
    world = cavbench.component("world", task)
    count = actions.shape[1]
    env = world.make([world.axes.cell(**cell)] * count)
    state = env.reset(TensorDict({"seed": FIRST + torch.arange(count)}, batch_size=[count]))
    steps = [state.set("reward", torch.zeros(count, 1))]
    for action in actions:
        steps.append(env.step(steps[-1].clone().set("action", torch.from_numpy(action)))["next"])
    names = ("observation", "reward", "terminated", "truncated")
    return {name: np.stack([step[name].squeeze(-1).numpy() for step in steps]) for name in names}


def parity(task: str, seeds: int) -> Counter[str]:
    """Count the steps that were compared, and those that differ."""
    import gymnasium
    import highway_env

    gymnasium.register_envs(highway_env)
    env = gymnasium.make(task, disable_env_checker=True)
    cell = {"lanes": env.unwrapped.config["lanes_count"], "density": 1.0}
    actions = planned(seeds, 50)
    engine = ours(task, actions, cell)
    counts: Counter[str] = Counter()
    for row in range(seeds):
        observation, _ = env.reset(seed=FIRST + row)
        reward, terminated, truncated, step = 0.0, False, False, 0
        while True:
            theirs = {
                "observation": observation,
                "reward": np.float32(reward),
                "terminated": terminated,
                "truncated": truncated,
            }
            counts["steps"] += step > 0
            for name, value in theirs.items():
                same = np.array_equal(engine[name][step, row], value)
                counts[f"other {name}"] += not same
            if terminated or truncated:
                break
            observation, reward, terminated, truncated, _ = env.step(int(actions[step, row]))
            step += 1
        counts["crashed"] += terminated
        counts["driven to the end"] += truncated
    return counts


def train(task: str, algorithm: str, steps: int, path: str) -> str:
    """Train a model in highway-env with the settings of its example scripts, and save it."""
    import gymnasium
    import highway_env
    from stable_baselines3 import DQN, PPO

    gymnasium.register_envs(highway_env)
    env = gymnasium.make(task)
    common: dict[str, Any] = {"learning_rate": 5e-4, "gamma": 0.8, "seed": 0, "device": "cpu"}
    if algorithm == "dqn":
        wide = {"net_arch": [256, 256]}
        rhythm = {"learning_starts": 200, "batch_size": 32, "train_freq": 1, "target_update_interval": 50}
        model: Any = DQN("MlpPolicy", env, policy_kwargs=wide, buffer_size=15_000, **rhythm, **common)
    else:
        two = {"net_arch": {"pi": [256, 256], "vf": [256, 256]}}
        model = PPO("MlpPolicy", env, policy_kwargs=two, n_steps=min(768, steps), batch_size=64, n_epochs=10, **common)
    model.learn(steps).save(path)
    return path


def model_of(path: str) -> Any:
    """A model of Stable-Baselines3, of the class that its file names."""
    import stable_baselines3

    from cavbench.driving.victims.sb3_saved import saved_model

    return getattr(stable_baselines3, saved_model(path).algorithm.upper()).load(path, device="cpu")


def evaluated(task: str, path: str, episodes: int) -> tuple[NDArray[np.float64], NDArray[np.bool_], Counter[str]]:
    """Returns and crashes [N] under Stable-Baselines3's `evaluate_policy`, one seed an episode, and the actions taken."""
    import gymnasium
    import highway_env
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    gymnasium.register_envs(highway_env)
    model = model_of(path)
    discrete = str(model.action_space).startswith("Discrete")
    env = make_vec_env(
        task, n_envs=1, env_kwargs={"config": {} if discrete else {"action": {"type": "ContinuousAction"}}}
    )
    returns, crashed = [], []
    taken: Counter[str] = Counter()
    for seed in range(FIRST, FIRST + episodes):
        ends: list[bool] = []

        def see(local: dict[str, Any], _: object, ends: list[bool] = ends) -> None:
            ends.append(bool(local["info"]["crashed"]))
            taken[str(np.round(local["actions"][0], 1))] += 1

        env.seed(seed)
        found, _ = evaluate_policy(model, env, n_eval_episodes=1, return_episode_rewards=True, callback=see)
        returns.append(found[0])
        crashed.append(ends[-1])
    return np.array(returns), np.array(crashed), taken


def policy(task: str, path: str, episodes: int) -> dict[str, object]:
    """The episodes of a policy there and here."""
    from cavbench.core.track import track
    from cavbench.records import reading

    theirs, crashed, taken = evaluated(task, path, episodes)
    home = dict(cavbench.component("world", task).home)
    with tempfile.TemporaryDirectory() as folder:
        victim = cavbench.component("victim", "sb3", path=path, trained_in=task)
        cavbench.score(victim, "none", world=task, **home, episodes=episodes, baselines=False, out=folder)
        records = reading.read(Path(folder), track=track("driving")).sort_by("seed")
    assert records["seed"].to_pylist() == list(range(FIRST, FIRST + episodes))
    ours = records["return"].to_numpy()
    differences = np.abs(ours - theirs)
    return {
        "episodes": episodes,
        "actions": dict(sorted(taken.items())) if len(taken) < 10 else len(taken),
        "mean return there": round(float(theirs.mean()), 4),
        "here": round(float(ours.mean()), 4),
        "largest difference of a return": float(differences.max()),
        "other return": int((differences > ROUNDING).sum()),
        "crashed there": int(crashed.sum()),
        "other crash": int((crashed != np.array(records["crashed"].to_pylist())).sum()),
    }


if __name__ == "__main__":
    without_avx512()
    began = time.process_time()
    kind, name, *rest = sys.argv[1:]
    match kind:
        case "parity":
            result: Any = dict(parity(name, int(rest[0])))
        case "train":
            result = train(name, rest[0], int(rest[1]), rest[2])
        case _:
            result = policy(name, rest[0], int(rest[1]))
    print(result, f"{time.process_time() - began:.0f} CPU s")
