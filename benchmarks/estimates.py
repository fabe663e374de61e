"""Compares what `bench run` says before and early in a run with what the run then takes:

    python benchmarks/estimates.py                              # the five runs of RUNS
    python benchmarks/estimates.py attack=zo lanes=4 episodes=5 # another one

Each run is driven by one worker in a process of its own, into an empty folder. Times are CPU seconds of that process, because
wall time on a shared machine says little. `start` is what passes before the first unit. `said before` is the line that every run
begins with, without the start. `said at 10 %` is the time that has passed and the time that is left, when a tenth of the work is
done; `worst later` is the largest error from there to 95 %.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence

from cavbench.run import runner
from cavbench.run.config import plan_of
from cavbench.run.forecast import Forecast
from cavbench.run.task import Task

RUNS = (
    "attack=pgd lanes=4 density=1 weather=clear,rain seeds=0,1 episodes=4",
    "attack=zo lanes=4 density=1 weather=clear seeds=0,1 episodes=5",
    "attack=pgd defense=shield lanes=4 density=1 weather=clear seeds=0 episodes=1",
    "attack=pgd world=merge seeds=0 episodes=2",
    "attack=eot victim=yolov5 attack.steps=40 lanes=3 density=1 weather=clear seeds=0 episodes=2",
)
"""An attack with gradients, one with queries, a filter, another world, and a detector."""


class Observer:
    """A watcher that keeps what the forecast says, in CPU seconds of this process."""

    def begin(self, *, episodes: int, finished: int, forecast: Forecast) -> None:
        forecast.now = time.process_time
        self.forecast, self.began = forecast, time.process_time()
        self.told: list[tuple[float, float]] = []
        self.last, self.heard = self.began, time.perf_counter()
        self._say()

    def working(self, tasks: Sequence[Task]) -> None:
        self.last, self.heard = time.process_time(), time.perf_counter()
        self.rate = 1.0
        self.forecast.working(tasks)

    def preparing(self, task: str, share: float, text: str, episodes: int = 0) -> None:
        self.forecast.reached(task, share, episodes)
        self._say()

    def finished(self, task: Task, wall_s: float) -> None:
        # The units of a batch are told of one after the other, when the batch is done.
        if (cpu := time.process_time() - self.last) > 1e-3:
            self.rate = cpu / (time.perf_counter() - self.heard)
        self.last, self.heard = time.process_time(), time.perf_counter()
        self.forecast.finished(task, wall_s * min(self.rate, 1.0))
        self._say()

    def _say(self) -> None:
        self.told.append((time.process_time(), self.forecast.left))

    def __getattr__(self, name: str) -> object:
        return lambda *arguments, **others: None


def observed(words: Sequence[str]) -> dict[str, float]:
    """Drive a run in this process, and return what was said of it and what it took."""
    with tempfile.TemporaryDirectory() as folder:
        plan = plan_of([*words, f"out={folder}", "executor=serial"])
        said = plan.cost.cpu_s
        observer = Observer()
        runner.run(plan, observer)  # type: ignore[arg-type]
    end = time.process_time()
    work = end - observer.began
    later = [(now, left) for now, left in observer.told if 0.1 * work <= now - observer.began <= 0.95 * work]
    now, left = later[0]
    return {
        "start": observer.began,
        "said": said,
        "took": work,
        "early": now - observer.began + left,
        "worst": max(((then + rest - end) / work for then, rest in later), key=abs),
    }


def main() -> None:
    """Print a table."""
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(observed(sys.argv[2:])))
        return
    runs = [" ".join(sys.argv[1:])] if sys.argv[1:] else RUNS
    print("| run | start | said before | took | said at 10 % | error | worst later |\n|---|---|---|---|---|---|---|")
    for words in runs:
        command = [sys.executable, __file__, "--one", *words.split()]
        out = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
        found = json.loads(out.splitlines()[-1])
        times = [f"{found[name]:.1f} s" for name in ("start", "said", "took", "early")]
        error = found["early"] / found["took"] - 1
        print(f"| `{words}` | {' | '.join(times)} | {error:+.0%} | {found['worst']:+.0%} |", flush=True)


if __name__ == "__main__":
    main()
