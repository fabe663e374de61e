"""The engine is highway-env, bit for bit, on each of its tasks: whole episodes, one process a task."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from cavbench.envs.roads.originals import ORIGINALS, original
from tests.envs.roads.side_by_side import exact_environment
from tests.tree import ROOT


def compared(task: str, seeds: int) -> dict[str, int]:
    """The counts of `side_by_side.compare` in a process of its own."""
    command = [sys.executable, "-W", "ignore", "-m", "tests.envs.roads.side_by_side", task, str(seeds)]
    done = subprocess.run(command, cwd=ROOT, env=exact_environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("task", ORIGINALS)
def test_whole_episodes_are_bit_equal(task: str) -> None:
    counts = compared(task, 5)
    assert not {name: count for name, count in counts.items() if name.startswith("differs")}
    assert counts["equal episodes"] == 5
    assert counts["steps"] > 25
    # A comparison that never met a crash would prove little.
    assert counts["crashed cars"] > 0 or "generic" in task


def test_a_task_that_is_not_reproduced_is_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match="task must be one of merge-v0"):
        original("parking-v0")
