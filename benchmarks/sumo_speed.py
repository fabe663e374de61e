"""Measures how many decisions a CPU second the worlds in SUMO's traffic make, its own processes included:

    python benchmarks/sumo_speed.py [--crossing] [--batch 16] [--seconds 5] [--lanes 2] [--density 1] [--vehicles 20]

With `--crossing` it is `sumo_crossing`. Whole episodes of a car that keeps its lane and speed, or of the rule-based driver,
resets included; a finished episode starts again at once. Compilation and the start of SUMO are not counted.
It needs `pip install 'cavbench[sumo]'`.
"""

from __future__ import annotations

import argparse
import os
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import psutil
from rich.console import Console

from cavbench.driving import Control, Driver
from cavbench.envs.highway.config import ACTIONS
from cavbench.envs.highway.engine import Flag
from cavbench.envs.sumo.crossing_world import SumoCrossingWorld
from cavbench.envs.sumo.engine import SumoEngine
from cavbench.envs.sumo.world import SumoWorld

GOAL = 5_000
SEED = 1_000_000
DRIVERS: tuple[Driver, ...] = ("idm", "agent")


def spent(engine: SumoEngine) -> tuple[float, float]:
    """CPU seconds so far: of this process, and of SUMO's."""
    theirs = [psutil.Process(one.process.pid).cpu_times() for one in engine.processes.processes]
    return time.process_time(), sum(times.user + times.system for times in theirs)


def rates(engine: SumoEngine, seconds: float) -> tuple[float, float, float]:
    """Decisions a CPU second, the share of SUMO's processes in it, and decisions a second of the clock."""
    batch = engine.config.batch
    engine.reset(np.arange(batch), np.arange(SEED, SEED + batch))
    idle, seed, decisions = np.full(batch, ACTIONS.index("IDLE")), SEED + batch, 0
    engine.step(idle)
    before, begin = spent(engine), time.perf_counter()
    while time.perf_counter() - begin < seconds:
        done = np.flatnonzero(engine.flags[Flag.DONE])
        if len(done):
            engine.reset(done, np.arange(seed, seed + len(done)))
            seed += len(done)
        engine.step(idle)
        decisions += batch
    ours, theirs = (now - then for now, then in zip(spent(engine), before, strict=True))
    return decisions / (ours + theirs), theirs / (ours + theirs), decisions / (time.perf_counter() - begin)


def main() -> None:
    """Measure, and print a line for each driver."""
    parser = argparse.ArgumentParser(description="Decisions a CPU second in SUMO's traffic.")
    parser.add_argument("--crossing", action="store_true")
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--lanes", type=int, default=2)
    parser.add_argument("--density", type=float, default=1.0)
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--processes", type=int, default=1)
    options = parser.parse_args()
    world = (SumoCrossingWorld if options.crossing else SumoWorld)(vehicles=options.vehicles)
    cells = (
        world.axes.cell(**dict(world.home) | {"lanes": options.lanes, "density": options.density}),
    ) * options.batch
    for driver in DRIVERS:
        engine = SumoEngine(world.configuration(cells, Control(driver=driver)), world.scene(), options.processes)
        rate, share, clock = rates(engine, options.seconds)
        engine.processes.close()
        Console().print(
            f"{driver}: {rate:,.0f} decisions a CPU second (goal {GOAL:,}), {share:.0%} of it SUMO; "
            f"{clock:,.0f} a second of the clock"
        )


if __name__ == "__main__":
    main()
