"""EnvPool's steps per CPU second in one of highway-env's tasks; `roads_speed.py --envpool` starts it where EnvPool is installed:

    python benchmarks/envpool_speed.py TASK SECONDS BATCH

The work is the same: whole episodes with random actions, one thread, finished episodes begin anew. Of most tasks EnvPool has
highway-env's first version alone, and of some one scenario for all seeds.
"""

from __future__ import annotations

import sys
import time

import envpool
import numpy as np

STEERING = 0.05


def rate(task: str, seconds: float, batch: int) -> float:
    """Steps per CPU second of this process, all episodes together."""
    env = envpool.make(task, env_type="gymnasium", num_envs=batch, num_threads=1, seed=0)
    generator, space = np.random.default_rng(0), env.action_space
    if hasattr(space, "n"):
        actions = generator.integers(0, space.n, (512, batch))
    else:
        actions = (generator.uniform(-1, 1, (512, batch, *space.shape)) * STEERING).astype(np.float32)
    env.reset()
    env.step(actions[0])
    steps, turn, start = 0, 0, time.process_time()
    while time.process_time() - start < seconds:
        env.step(actions[turn % len(actions)])
        steps, turn = steps + batch, turn + 1
    return steps / (time.process_time() - start)


if __name__ == "__main__":
    sys.stdout.write(f"{rate(sys.argv[1], float(sys.argv[2]), int(sys.argv[3]))}\n")
