"""Measures the back ends: what a driver sustains with tasks that do nothing, and Ray against processes on one pair.

    python benchmarks/executor_speed.py
    python benchmarks/executor_speed.py --tasks 2000 --rounds 3

Prints the figures that docs/scale.md and `studies/cluster_cost.py` use. Capacity is the number of tasks for which a second of
the driver's CPU time is enough: on a busy machine wall time says little. Ray and processes drive the pair in turns; the ratios of
wall time and of the CPU time of all processes are medians over the rounds.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import pickle
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from itertools import chain
from pathlib import Path

import psutil
import pyarrow as pa

from cavbench.core.track import track
from cavbench.errors import in_one_line
from cavbench.isolation.framework import Snapshot
from cavbench.records import packing, reading, store
from cavbench.run import runner
from cavbench.run.attempt import attempt
from cavbench.run.config import plan_of
from cavbench.run.executors import EXECUTORS
from cavbench.run.plan import Plan
from cavbench.run.process import cores
from cavbench.run.task import Outcome, Task

PAIR = ("defense=none", "victim=dqn", "lanes=3,4", "density=1", "weather=clear,fog", "seeds=0,1")
QUIET = ("record=0", "reference=false")


class Silent:
    """A watcher that says nothing."""

    def begin(self, *, episodes: int, finished: int, forecast: object) -> None:
        pass

    def __getattr__(self, name: str) -> object:
        return lambda *arguments: None


def nothing(plan: Plan) -> Task:
    """A task that loads a victim without weights."""
    return replace(plan.loadings[0], cells=(), asks_world=False)


def throughput(name: str, count: int) -> tuple[float, float]:
    """Finished tasks a second of wall time, and of the driver's CPU time. Nothing is written."""
    plan = plan_of(["victim=blind", f"executor={name}", "unit_timeout=600", "unit_memory=0"])
    with closing(EXECUTORS[name](plan)) as back_end:
        # The first tasks wait for the workers to start.
        list(back_end.map([nothing(plan) for _ in range(2 * cores())], Silent()))  # type: ignore[arg-type]
        start, used = time.perf_counter(), time.process_time()
        tasks = (nothing(plan) for _ in range(count))
        ended = list(chain.from_iterable(back_end.map(tasks, Silent())))  # type: ignore[arg-type]
        seconds, used = time.perf_counter() - start, time.process_time() - used
    assert len(ended) == count
    assert not any(outcome.failed for _, outcome in ended)
    return count / seconds, count / used


def milliseconds(work: Callable[[], object], count: int) -> float:
    """CPU time of each of `count` calls."""
    work()
    start = time.process_time()
    for _ in range(count):
        work()
    return 1e3 * (time.process_time() - start) / count


def of_records() -> None:
    """Print what the records of a unit of 100 episodes cost the driver."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        words = [word for word in PAIR if not word.startswith(("lanes", "weather", "seeds"))]
        more = ("attack=noise", "lanes=3", "weather=clear", "seeds=0", "episodes=100", "executor=serial", *QUIET)
        units = runner.run(plan_of([*words, *more, f"out={out}"]), Silent())
        records = reading.read(out, units[:1], track=track("driving"))
        sent = pickle.dumps(Outcome(wall_s=1.0, records=records), pickle.HIGHEST_PROTOCOL)
        many = [_renamed(records, number) for number in range(packing.UNITS)]
        print(
            f"{len(sent) / 1e3:.0f} kB are sent back, unpickled in {milliseconds(lambda: pickle.loads(sent), 50):.1f} ms"
        )
        print(f"written to a file of its own in {milliseconds(lambda: store.write(out, records), 30):.1f} ms")
        together = milliseconds(lambda: store.write_all(out, many), 1) / len(many)
        size = max(path.stat().st_size for path in packing.packed_files(out)) / len(many)
        alone = store.path_of(out, units[0]).stat().st_size
        print(f"written with {len(many)} in {together:.2f} ms; {alone / 1e3:.0f} kB alone, {size / 1e3:.1f} kB packed")


def _renamed(records: pa.Table, number: int) -> pa.Table:
    place = records.schema.get_field_index("unit")
    column = pa.array([f"{number:064x}"] * records.num_rows)
    return records.set_column(place, records.schema.field("unit"), column)


def pair_seconds(name: str, attack: str, episodes: int) -> tuple[float, float, float]:
    """Wall time and CPU time of one pair, with the start of the workers, and the megabytes of the largest child.

    The CPU time is that of this process and all its descendants, Ray's own included, as far as they were seen alive.
    """
    with tempfile.TemporaryDirectory() as folder:
        words = [f"attack={attack}", *PAIR, *QUIET, f"episodes={episodes}", f"executor={name}", f"out={folder}"]
        largest = 0.0
        used: dict[tuple[int, float], float] = {}

        class Watching(Silent):
            def working(self, tasks: object) -> None:
                nonlocal largest
                # Ray's own processes have a few hundred MB as well.
                for child in psutil.Process().children(recursive=True):
                    # It may end at any time.
                    with contextlib.suppress(psutil.Error):
                        times, size = child.cpu_times(), child.memory_info().rss
                        largest = max(largest, size / 1e6)
                        used[child.pid, child.create_time()] = times.user + times.system

        start, own = time.perf_counter(), time.process_time()
        runner.run(plan_of(words), Watching())
        return time.perf_counter() - start, time.process_time() - own + sum(used.values()), largest


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description="Measure the back ends of `bench run`.")
    parser.add_argument("--tasks", type=int, default=500, help="tasks that do nothing")
    parser.add_argument("--attack", default="noise", help="attack of the pair; a longer pair hides the start of Ray")
    parser.add_argument("--episodes", type=int, default=100, help="episodes of a unit of the pair")
    parser.add_argument(
        "--rounds", type=int, default=1, help="runs of the pair with each back end, in turns; 0 for none"
    )
    arguments = parser.parse_args()
    names = ["processes", *(["ray"] if importlib.util.find_spec("ray") else [])]
    for name in names:
        wall, capacity = throughput(name, arguments.tasks)
        print(
            f"{name}: {wall:.0f} tasks that do nothing a second on {cores()} cores; capacity of the driver {capacity:.0f}"
        )
    framework, task = Snapshot(), nothing(plan_of(["victim=blind"]))
    print(f"a worker takes {milliseconds(lambda: attempt(task, lambda *news: None, framework), 100):.1f} ms a task")
    of_records()
    rounds = [
        {name: pair_seconds(name, arguments.attack, arguments.episodes) for name in names}
        for _ in range(arguments.rounds)
    ]
    for name in names if rounds else ():
        wall, cpu, memory = (statistics.median(one[name][at] for one in rounds) for at in range(3))
        print(f"{name}: {wall:.1f} s for the pair, {cpu:.1f} s of CPU time, {memory:.0f} MB the largest worker")
    print(f"driver: {psutil.Process().memory_info().rss / 1e6:.0f} MB")
    if rounds and len(names) > 1:
        wall, cpu = (statistics.median(one["ray"][at] / one["processes"][at] for one in rounds) for at in (0, 1))
        print(f"Ray takes {wall:.2f} x of processes, {cpu:.2f} x in CPU time, with the start of the workers")


if __name__ == "__main__":
    with in_one_line():
        sys.exit(main())
