"""The engine is highway-env, bit for bit, on each of its tasks: whole episodes."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from cavbench.envs.roads.originals import ORIGINALS, original
from tests.envs.roads.side_by_side import exact_environment
from tests.tree import ROOT

CROSSINGS = [task for task in ORIGINALS if task.startswith("intersection")]
OTHERS = [task for task in ORIGINALS if task not in CROSSINGS]


def compared(tasks: list[str], seeds: int) -> list[dict[str, int]]:
    """The counts of `side_by_side.compare` for each task, in a process of their own."""
    command = [sys.executable, "-W", "ignore", "-m", "tests.envs.roads.side_by_side", ",".join(tasks), str(seeds)]
    done = subprocess.run(command, cwd=ROOT, env=exact_environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.parametrize("tasks", [OTHERS, CROSSINGS], ids=["roads", "crossings"])
def test_whole_episodes_are_bit_equal(tasks: list[str]) -> None:
    counts = compared(tasks, 2)
    assert [count["task"] for count in counts] == tasks
    assert [count for count in counts if count["equal episodes"] != 2] == []
    # A comparison that never met a crash would prove little.
    assert sum(count["crashed cars"] for count in counts) > 0


def test_a_task_that_is_not_reproduced_is_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match="task must be one of merge-v0"):
        original("parking-v0")
