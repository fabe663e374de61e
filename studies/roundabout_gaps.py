"""How often an ego that waits at the ring of `roundabout` may enter in the worst case: `python studies/roundabout_gaps.py`.

Tuning seeds, clear weather, the ego waits on its arm. A car's set is all routes that it can take: what is on the ring may come
round to the ego's entry, what is on an arm may enter. The gap is free if no car can be there within the time in which the ego
gets from standing to the ring. `steady`: a car keeps its speed. `worst`: it accelerates at 6 m/s2, as `tracker` assumes.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from cavbench.core.pair import choose
from cavbench.driving import Control
from cavbench.envs.roads.network import CAR_LENGTH
from cavbench.envs.roads.roundabout import ALPHA, GAP, RADIUS
from cavbench.run.process import settle
from cavbench.scenarios import SeedBlock

ENTER_M, TARGET, DELAY_S = 17.0, 8.0, 0.6
"""From the line to the ring in m, the first target speed in m/s, and the time constant of the ego's speed in s."""
HARDEST = 6.0
ENTRY = np.deg2rad(90 - ALPHA)
"""The angle of the ego's entry; cars come from larger angles."""
ARMS = {"east": np.deg2rad(-ALPHA), "north": np.deg2rad(-90 - ALPHA), "west": np.deg2rad(180 - ALPHA)}
"""The angles of the other entries."""
OUTER = RADIUS + GAP
RING = OUTER + GAP
"""A car nearer to the middle than this, in m, is on the ring."""


def seconds() -> float:
    """The time in s in which the ego gets from standing to the ring, towards the first target speed."""
    times = np.arange(0, 10, 0.01)
    way = TARGET * (times - DELAY_S * (1 - np.exp(-times / DELAY_S)))
    return float(times[np.searchsorted(way, ENTER_M)])


def upstream(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Metres that a car at x, y must drive to the ego's entry; inf for one that does not come there any more."""
    found = np.full(x.shape, np.inf)
    ring = np.hypot(x, y) < RING
    found[ring] = (np.remainder(np.arctan2(y, x) - ENTRY, 2 * np.pi) * RADIUS)[ring]
    # The entries are on the left of each arm for those who come, so on one side of its axis.
    arms = {"east": (x > abs(y)) & (y < 0), "north": (-y > abs(x)) & (x < 0), "west": (-x > abs(y)) & (y > 0)}
    for name, here in arms.items():
        on_arm = here & ~ring
        found[on_arm] = (np.remainder(ARMS[name] - ENTRY, 2 * np.pi) * RADIUS + np.hypot(x, y) - OUTER)[on_arm]
    return found


@torch.no_grad()
def main() -> None:
    """Print a row for each density."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", type=int, default=20)
    count = parser.parse_args().scenarios
    settle()
    world, wait = choose("world", "roundabout").component, seconds()
    print(f"the ego needs {wait:.1f} s")
    print("| density | steady, of the decisions | never | worst, of the decisions | never |\n|---|---|---|---|---|")
    for density in world.axes.cell(density=1.0), world.axes.cell(density=2.0):
        env = world.build([density] * count, Control())
        td = env.reset(TensorDict({"seed": torch.arange(count) + SeedBlock.TUNE}, batch_size=env.batch_size))
        free: list[NDArray[np.bool_]] = []
        for _ in range(world.max_steps):
            bodies = env.engine.bodies[:, 1:]
            far = upstream(bodies["x"], bodies["y"]) - CAR_LENGTH
            reach = bodies["speed"] * wait
            cars = np.arange(bodies.shape[1]) < env.engine.episodes["cars"][:, None] - 1
            free.append(np.stack([((far > one) | ~cars).all(1) for one in (reach, reach + HARDEST / 2 * wait**2)], 1))
            td = env.step(td.set("action", torch.full((count,), world.actions.index("SLOWER"))))["next"]
        shares = np.stack(free)
        cells = [f"{shares[..., one].mean():.0%} | {(~shares[..., one].any(0)).sum()} of {count}" for one in (0, 1)]
        print(f"| {density.density:g} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
