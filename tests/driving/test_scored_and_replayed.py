"""Components with a state can be run, recorded and replayed, and the replay is equal to the last bit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pyarrow.compute as pc
import pytest
from rerun.chunk import RrdReader

from cavbench.core.track import track
from cavbench.records import reading
from cavbench.run import runner
from cavbench.run.config import plan_of
from cavbench.run.replay import find, replay
from cavbench.run.task import Task

ATTACKS = ("bias", "pgd")
RUN = (
    f"attack={','.join(ATTACKS)} defense=frame_stack victim=dqn lanes=3 density=1 weather=clear episodes=3 seeds=0 "
    "reference=false world.max_steps=60"
)


class Warned:
    """A watcher that collects the warnings."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.failures: list[str] = []
        self.said: list[str] = []

    def begin(self, *, episodes: int, finished: int, forecast: object) -> None:
        pass

    def working(self, tasks: Sequence[Task]) -> None:
        pass

    def preparing(self, task: str, share: float, text: str, episodes: int = 0) -> None:
        pass

    def finished(self, task: Task, wall_s: float) -> None:
        pass

    def failed(self, line: str) -> None:
        self.failures.append(line)

    def printed(self, task: object, lines: Sequence[str]) -> None:
        self.said += lines

    def warn(self, line: str) -> None:
        self.lines.append(line)


@pytest.mark.slow
@pytest.mark.parametrize("back_end", ["executor=serial", "workers=2"])
def test_a_stateful_attack_on_a_stateful_defence_is_scored_recorded_and_replayed(tmp_path: Path, back_end: str) -> None:
    watcher = Warned()
    runner.run(plan_of([*RUN.split(), back_end, f"out={tmp_path}"]), watcher)
    assert watcher.lines == []
    records = reading.read(tmp_path, track=track("driving"))
    assert set(records["attack"].to_pylist()) >= set(ATTACKS)
    assert pc.max(records["excess_max"]).as_py() < 1e-6
    for attack in ATTACKS:
        (recording,) = tmp_path.glob(f"recordings/{attack}-frame_stack-dqn-*/*-1000000.rrd")
        entities = {str(chunk.entity_path) for chunk in RrdReader(recording).stream()}
        assert {"/traffic/shown", "/decision/clean", "/perturbation/position/x"} <= entities
        again = replay(tmp_path, find(records, {"attack": attack, "seed": "1000002"}))
        assert (again.differences, again.changed) == ((), "")
        assert again.path.name == "lanes-3-density-1-weather-clear-1000002.rrd"
