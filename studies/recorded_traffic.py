"""Real and synthetic traffic side by side: the distance to the car ahead, speeds, and how fast cars close in.

    bench fetch ngsim
    python -m studies.recorded_traffic [--figure PICTURE]

Of every car on the lanes that has another one ahead in its lane, once a second. Synthetic traffic is that of some worlds, with
the ego driven by the rule-based driver, and the first second left out.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavbench.core.options import configured
from cavbench.envs.recorded.frames import _on
from cavbench.envs.recorded.world import RecordedWorld

SCENES = ("us101_23_1", "us101_3_1", "lanker_2_23")
WORLDS = (
    ("highway", {"lanes": 4, "density": 1.0}),
    ("highway", {"lanes": 4, "density": 2.0}),
    ("merge", {"density": 4.0, "ramp": 80.0}),
    ("exit", {"lanes": 6, "density": 1.5}),
)
EPISODES = 30
Pairs = NDArray[np.float64]
"""[N, 3] metres to the car ahead from bumper to bumper, the speed in m/s, and the speed at which the distance falls."""


def followers(x: Pairs, lane: NDArray[np.int64], speed: Pairs, length: Pairs) -> Pairs:
    """The pairs of cars that follow each other at one moment; all arrays are of the cars on the lanes."""
    found = []
    for number in np.unique(lane):
        own = np.flatnonzero(lane == number)
        own = own[np.argsort(x[own])]
        behind, ahead = own[:-1], own[1:]
        gap = x[ahead] - x[behind] - (length[ahead] + length[behind]) / 2
        found.append(np.stack([gap, speed[behind], speed[behind] - speed[ahead]], 1))
    return np.concatenate(found) if found else np.zeros((0, 3))


def recorded(name: str) -> Pairs:
    """The pairs of a recorded scene."""
    world = RecordedWorld()
    path, sha256 = world._file(name)
    from cavbench.envs.recorded.stages import staged

    stage = staged(path, sha256, 10, 3.0, 0.0)
    tracks, frames = stage.recordings.tracks, stage.recordings.frames
    last = int((tracks["first"] + tracks["count"]).max())
    found = []
    for frame in range(0, last, 10):
        at = np.where(tracks["stands"], 0, frame - tracks["first"])
        there = np.flatnonzero((at >= 0) & (at < tracks["count"]))
        states = frames[tracks["offset"][there] + at[there]]
        on = _on(stage.corridor, states)
        lane = np.round(states[on, 1] / stage.corridor.lane_width).astype(np.int64)
        found.append(followers(states[on, 0], lane, states[on, 3], tracks["length"][there][on]))
    return np.concatenate(found)


def synthetic(name: str, cell: dict[str, Any]) -> Pairs:
    """The pairs of the traffic of a world."""
    world: Any = configured("world", name, {}).component
    cells = (world.axes.cell(**cell, weather="clear"),) * EPISODES
    engine: Any = world.make(cells, driver="idm").engine
    engine.reset(np.arange(EPISODES), np.arange(1_000_000, 1_000_000 + EPISODES))
    return np.concatenate(list(_moments(engine, world)))


def _moments(engine: Any, world: Any) -> Iterator[Pairs]:
    hz = world.policy_frequency
    for step in range(1, 10 * hz + 1):
        engine.step(np.ones(EPISODES, dtype=np.int64))
        if step % hz:
            continue
        bodies = engine.vehicles if hasattr(engine, "vehicles") else engine.bodies
        running = ~(engine.episodes["terminated"] | engine.episodes["truncated"])
        for row in np.flatnonzero(running):
            cars = bodies[row][1:]
            if "kind" in (cars.dtype.names or ()):
                cars = bodies[row][1 : engine.episodes["cars"][row]]
            near = np.abs(cars["x"] - bodies[row][0]["x"]) < 150
            cars = cars[near]
            yield followers(cars["x"], cars["lane"].astype(np.int64), cars["speed"], np.full(len(cars), 5.0))


def line(name: str, pairs: Pairs) -> str:
    """A line of the table."""
    gap, speed, closing = pairs[pairs[:, 0] > 0].T
    moving = speed > 1
    headway = gap[moving] / speed[moving]
    with np.errstate(divide="ignore"):
        ttc = np.where(closing > 0, gap / np.maximum(closing, 1e-9), np.inf)
    cells = [
        f"{np.median(gap):.0f} ({np.percentile(gap, 10):.0f} to {np.percentile(gap, 90):.0f})",
        f"{np.median(headway):.1f} ({np.percentile(headway, 10):.1f} to {np.percentile(headway, 90):.1f})",
        f"{np.median(speed):.1f} ({np.percentile(speed, 10):.1f} to {np.percentile(speed, 90):.1f})",
        f"{closing.std():.1f}",
        f"{100 * (ttc < 5).mean():.1f} %",
        f"{len(gap):,}",
    ]
    return f"| {name} | {' | '.join(cells)} |"


def main() -> None:
    reader = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    reader.add_argument("--figure", type=Path)
    given = reader.parse_args()
    every = {f"`recorded`, {name}": recorded(name) for name in SCENES}
    for name, cell in WORLDS:
        every[f"`{name}`, {', '.join(f'{axis} {value:g}' for axis, value in cell.items())}"] = synthetic(name, cell)
    print("| traffic | gap in m | time gap in s | speed in m/s | closing, deviation in m/s | TTC below 5 s | pairs |")
    print("|---|---|---|---|---|---|---|")
    for name, pairs in every.items():
        print(line(name, pairs))
    if given.figure is not None:
        draw(every, given.figure)


def draw(every: dict[str, Pairs], path: Path) -> None:
    """The distributions as a picture."""
    from docs.figures import style

    made = style.figure(3.2, "real and synthetic traffic")
    columns = made.subplots(1, 3)
    shown = (
        ("US-101, recorded", [pairs for name, pairs in every.items() if "us101" in name], style.BLUE),
        ("Lankershim, recorded", [pairs for name, pairs in every.items() if "lanker" in name], style.SKY),
        ("highway, density 1", [every["`highway`, lanes 4, density 1"]], style.RED),
    )
    labels = ("gap in m", "speed in m/s", "closing speed in m/s")
    limits = ((0, 80), (0, 35), (-8, 8))
    for column, axes in enumerate(columns):
        for name, parts, colour in shown:
            values = np.concatenate(parts)[:, column]
            axes.hist(
                values, bins=np.linspace(*limits[column], 33), density=True, histtype="step", color=colour, label=name
            )
        axes.set(xlabel=labels[column], xlim=limits[column], yticks=[])
    columns[0].legend(loc="upper right", fontsize=8)
    style.save(made, path)


if __name__ == "__main__":
    main()
