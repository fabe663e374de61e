"""Measures the back ends: what a driver sustains with tasks that do nothing, and Ray against processes on one pair.

python benchmarks/executor_speed.py                  # both
python benchmarks/executor_speed.py --tasks 5000     # more tasks that do nothing
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from bench.plugins.pair import Pair, choose
from bench.records import store
from bench.run import runner
from bench.run.config import run_config
from bench.run.executors import EXECUTORS
from bench.run.process import cores
from bench.run.unit import Loading
from bench.run.work import Outcome, Task
from bench.run.worker import Limits
from bench.victims.drivers.reference import Blind

PAIR = ("attack=noise", "defense=none", "victim=dqn", "lanes=3,4", "density=1", "weather=clear,fog", "seeds=0,1")


class Silent:
    """A watcher that says nothing."""

    def begin(self, *, episodes: int, finished: int) -> None:
        pass

    def __getattr__(self, name: str) -> object:
        return lambda *arguments: None


def throughput(name: str, count: int) -> tuple[float, float]:
    """Finished tasks a second of wall time, and of the driver's CPU time.

    Each task loads a victim without weights, and nothing is written.
    """
    blind = choose("victim", "blind")
    assert isinstance(blind.component, Blind)
    pair = Pair(
        attack=choose("attack", "none"),
        defense=choose("defense", "none"),
        victim=blind,
        world=choose("world", "highway"),
        threat=blind.component.threat.of_nobody(),
    )
    work = Loading(pair=pair, training_seed=0)
    with closing(EXECUTORS[name](None, Limits(seconds=600), "local")) as back_end:
        # The first tasks wait for the workers to start.
        for _ in back_end.map([Task(work=work) for _ in range(2 * cores())], Silent()):  # type: ignore[arg-type]
            pass
        start, used = time.perf_counter(), time.process_time()
        outcomes = [outcome for some in back_end.map((Task(work=work) for _ in range(count)), Silent()) for _, outcome in some]  # type: ignore[arg-type]
        seconds, used = time.perf_counter() - start, time.process_time() - used
    assert all(isinstance(outcome, Outcome) for outcome in outcomes)
    return count / seconds, count / used


def written(count: int) -> float:
    """Records of units written a second, one file each."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        runner.run(
            run_config([*PAIR, "episodes=4", "executor=serial", "record=0", "reference=false", f"out={out}"]), Silent()
        )  # type: ignore[arg-type]
        from bench.plugins.track import track
        from bench.records import reading

        path = next((out / store.FOLDER).glob("*.parquet"))
        records = reading.read(out, [path.stem], track=track("driving"))
        start = time.perf_counter()
        for _ in range(count):
            store.write(out, records)
        return count / (time.perf_counter() - start)


def pair_seconds(name: str, episodes: int) -> float:
    """Wall time of one pair, with the start of the workers."""
    with tempfile.TemporaryDirectory() as folder:
        words: Sequence[str] = [*PAIR, f"episodes={episodes}", f"executor={name}", "record=0", "reference=false"]
        start = time.perf_counter()
        runner.run(run_config([*words, f"out={folder}"]), Silent())  # type: ignore[arg-type]
        return time.perf_counter() - start


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description="Measure the back ends of `bench run`.")
    parser.add_argument("--tasks", type=int, default=2000, help="tasks that do nothing")
    parser.add_argument("--episodes", type=int, default=100, help="episodes of a unit of the pair")
    parser.add_argument("--rounds", type=int, default=3, help="runs of the pair with each back end, in turns")
    arguments = parser.parse_args()
    names = ["processes", *(["ray"] if importlib.util.find_spec("ray") else [])]
    for name in names:
        wall, used = throughput(name, arguments.tasks)
        print(f"{name}: {wall:.0f} tasks that do nothing a second; the driver's CPU time is enough for {used:.0f}")
    print(f"records of {written(300):.0f} units written a second")
    rounds = [{name: pair_seconds(name, arguments.episodes) for name in names} for _ in range(arguments.rounds)]
    best = {name: min(one[name] for one in rounds) for name in names}
    print(", ".join(f"{name} {seconds:.1f} s" for name, seconds in best.items()), f"(best of {arguments.rounds})")
    if "ray" in best:
        print(f"Ray takes {best['ray'] / best['processes']:.2f} x of processes, with the start of the workers")


if __name__ == "__main__":
    sys.exit(main())
