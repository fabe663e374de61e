"""Drives what is missing of the published leaderboard, the cheapest row first, and publishes each row when it is done.

    python -m cavbench.leaderboard.job --list       # what is missing, and what it costs
    python -m cavbench.leaderboard.job --hours 2    # the rows that fit in two hours of CPU; `make publish` drives them all

A row is whole when it has the suite, the trainings and the scenarios of its grid. What is driven is kept in a folder of the row
until then: a job that was killed goes on where it was. The published files are the state of the job.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from cavbench.leaderboard.published import HOME, publish
from cavbench.run.config import plan_of
from cavbench.run.cost import spoken
from cavbench.run.plan import Plan

ALWAYS = ("attack=standard", "record=0")


@dataclass(frozen=True)
class Wanted:
    """A row of the leaderboard.

    Args:
        words: what chooses its victim and its defence, as for `bench run`.
        home: the folder of the published files.
        out: where results folders are.
    """

    words: tuple[str, ...]
    home: Path
    out: Path

    @cached_property
    def plan(self) -> Plan:
        """What drives all of it."""
        return plan_of([*ALWAYS, *self.words, f"out={self.folder}"])

    @property
    def folder(self) -> Path:
        """Its results folder."""
        return self.out / self.name

    @property
    def name(self) -> str:
        """The name of its published files."""
        named = dict(word.split("=", 1) for word in self.words)
        return "+".join(named[kind] for kind in ("victim", "defense") if kind in named)

    @property
    def face(self) -> dict[str, Any]:
        """What is published of it; empty for nothing."""
        file = self.home / "rows" / self.plan.grid.name / f"{self.name}.json"
        return dict(json.loads(file.read_text())) if file.exists() else {}

    @property
    def missing(self) -> str:
        """What it lacks; empty if it is whole."""
        face, plan = self.face, self.plan
        if not face:
            return "all"
        wanted = len(plan.seeds) if any(pair.is_seeded for pair in plan.pairs) else 1
        parts = (
            ("trainings", len(face["training_seeds"]), wanted),
            ("scenarios", face["scenarios"], plan.grid.episodes),
            ("attacks", len(face["attacks"]), len(plan.pairs)),
        )
        return ", ".join(f"{there} of {asked} {noun}" for noun, there, asked in parts if there < asked)

    def drive(self) -> bool:
        """Drive and publish it; whether that went well."""
        if not driven([*ALWAYS, *self.words, f"out={self.folder}"]):
            return False
        publish(self.folder, self.home, add=True)
        return True


def driven(words: Sequence[str]) -> bool:
    """Drive a run in a process of its own; whether that went well."""
    command = [sys.executable, "-m", "cavbench", "run", *words, "--yes"]
    return subprocess.run(command, stdout=subprocess.DEVNULL).returncode == 0


def wanted_rows(home: Path, out: Path) -> list[Wanted]:
    """The rows of `board.toml`."""
    rows = tomllib.loads((home / "board.toml").read_text())["row"]
    return [Wanted(tuple(row["words"]), home, out) for row in rows]


def main(words: Sequence[str] | None = None) -> int:
    """The command of this module; returns 1 if a row could not be driven."""
    parser = argparse.ArgumentParser(description="Drive and publish what is missing of the leaderboard.")
    parser.add_argument("--list", action="store_true", help="say what is missing and what it costs, and end")
    parser.add_argument("--hours", type=float, default=float("inf"), help="most hours of CPU")
    parser.add_argument(
        "--out", type=Path, default=Path("results/board"), help="where results are until a row is whole"
    )
    given = parser.parse_args(words)
    console = Console()
    with as_file(files(HOME)) as home:
        missing = sorted(
            (row for row in wanted_rows(home, given.out) if row.missing), key=lambda row: row.plan.cost.cpu_s
        )
        table = Table("row", "published", "CPU, at most", box=None)
        for row in missing:
            table.add_row(row.name, row.missing, spoken(row.plan.cost.cpu_s))
        table.add_row("all", "", spoken(sum(row.plan.cost.cpu_s for row in missing)))
        console.print(table)
        failed, left = 0, 3600 * given.hours
        for row in missing if not given.list else ():
            left -= row.plan.cost.cpu_s
            if left < 0:
                console.print(f"{row.name} does not fit in the hours that are left")
                break
            done = row.drive()
            failed += not done
            console.print(
                f"{row.name}: {'published' if done else 'could not be driven whole; the next job tries again'}"
            )
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
