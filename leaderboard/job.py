"""Drives what is missing of the published leaderboard, the cheapest row first, and publishes each row when it is done.

    python -m cavbench.leaderboard.job --list       # what is missing, and what it costs
    python -m cavbench.leaderboard.job --hours 2    # the rows that fit in two hours of CPU; `make publish` drives them all

A row is whole when it has the suite, the trainings and the scenarios of its grid. Networks that the zoo lacks are trained first.
What is driven is kept in a folder of the row until it is whole: a job that was killed goes on where it was.
The published files are the state of the job.
"""

from __future__ import annotations

import argparse
import json
import shlex
import statistics
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

from cavbench import zoo
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

    @cached_property
    def trainings(self) -> Trainings:
        """What the zoo lacks for it."""
        pair = self.plan.pairs[0]
        defense = pair.defense.component if pair.defense.component.learns else None
        if not (pair.is_seeded and (defense or pair.victim.component.learns)):
            return Trainings(None, ())
        recipe = zoo.Recipe.of(pair.victim.component, defense)
        there = zoo.seeds(recipe)
        return Trainings(recipe, tuple(seed for seed in self.plan.seeds if seed not in there))

    @property
    def cpu_s(self) -> float:
        """What it costs at most, in CPU seconds."""
        return self.trainings.cpu_s + self.plan.cost.cpu_s

    def drive(self) -> bool:
        """Train what is missing, drive and publish it; whether that went well."""
        if not all(ended(command) for command in self.trainings.commands):
            return False
        if not driven([*ALWAYS, *self.words, f"out={self.folder}"]):
            return False
        publish(self.folder, self.home, add=True)
        return True


@dataclass(frozen=True)
class Trainings:
    """The trainings that the zoo lacks for a row.

    Args:
        recipe: what is trained; None for what does not learn.
        seeds: the training seeds.
    """

    recipe: zoo.Recipe | None
    seeds: tuple[int, ...]

    @property
    def cpu_s(self) -> float:
        """What they cost in CPU seconds: each the mean of those in the zoo, or nothing if there is none."""
        if self.recipe is None or not (there := zoo.seeds(self.recipe)):
            return 0.0
        return len(self.seeds) * statistics.mean(zoo.card(self.recipe, seed)["cpu_seconds"] for seed in there)

    @property
    def commands(self) -> list[list[str]]:
        """The words of `bench` that train each."""
        return [] if self.recipe is None else [shlex.split(self.recipe.train(seed))[1:] for seed in self.seeds]


def driven(words: Sequence[str]) -> bool:
    """Drive a run in a process of its own; whether that went well."""
    return ended(["run", *words, "--yes"])


def ended(words: Sequence[str]) -> bool:
    """Run `bench` in a process of its own; whether that went well."""
    return subprocess.run([sys.executable, "-m", "cavbench", *words], stdout=subprocess.DEVNULL).returncode == 0


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
        missing = sorted((row for row in wanted_rows(home, given.out) if row.missing), key=lambda row: row.cpu_s)
        table = Table("row", "published", "to train", "CPU, at most", box=None)
        for row in missing:
            table.add_row(row.name, row.missing, str(len(row.trainings.seeds)), spoken(row.cpu_s))
        table.add_row("all", "", "", spoken(sum(row.cpu_s for row in missing)))
        console.print(table)
        failed, left = 0, 3600 * given.hours
        for row in missing if not given.list else ():
            left -= row.cpu_s
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
