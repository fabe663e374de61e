"""Drives the rows of the leaderboard over worlds (`worlds.toml`), and publishes them.

    python -m cavbench.leaderboard.worlds_job --list       # the runs and their cost
    python -m cavbench.leaderboard.worlds_job --hours 1    # drives what fits in an hour of CPU, then publishes

What is driven is kept in a results folder: a job that was killed goes on where it was. A run that is there costs seconds.
"""

from __future__ import annotations

import argparse
import sys
import tomllib
from collections.abc import Sequence
from importlib.resources import as_file, files
from pathlib import Path

from rich.console import Console
from rich.table import Table

from cavbench.core.track import track
from cavbench.leaderboard.job import driven
from cavbench.leaderboard.published import HOME, publish_worlds
from cavbench.leaderboard.ranking.methods import EACH
from cavbench.leaderboard.ranking.methods import HOME as TRAINED_IN
from cavbench.run.config import plan_of
from cavbench.run.cost import spoken

ALWAYS = ("record=0", "executor=serial")


def runs(table: Path) -> list[tuple[str, ...]]:
    """The words of each run of a table: row by row, each in its worlds. So a job that ends early leaves whole rows."""
    found = tomllib.loads(table.read_text(encoding="utf-8"))
    made = []
    for row in found["row"]:
        for world in row.get("worlds", found["world"]):
            # A row may choose another attack.
            given = (*found["words"], *found["world"][world]["words"], *row["words"])
            words = dict(word.split("=", 1) for word in given)
            if row.get("trained") == EACH and world != track("driving").world:
                words[f"victim.{TRAINED_IN}"] = world
            made.append((f"world={world}", *(f"{key}={value}" for key, value in words.items())))
    return made


def main(words: Sequence[str] | None = None) -> int:
    """The command of this module; returns 1 if a run failed."""
    parser = argparse.ArgumentParser(description="Drive and publish the rows of the leaderboard over worlds.")
    parser.add_argument("--list", action="store_true", help="say what it costs, and end")
    parser.add_argument("--hours", type=float, default=float("inf"), help="most hours of CPU")
    parser.add_argument("--out", type=Path, default=Path("results/worlds"), help="results folder")
    given = parser.parse_args(words)
    console = Console()
    with as_file(files(HOME)) as home:
        planned = [(own, plan_of([*own, *ALWAYS, f"out={given.out}"]).cost.cpu_s) for own in runs(home / "worlds.toml")]
        if given.list:
            table = Table("run", "CPU, at most", box=None)
            for own, seconds in planned:
                table.add_row(" ".join(own), spoken(seconds))
            table.add_row("all", spoken(sum(seconds for _, seconds in planned)))
            console.print(table)
            return 0
        failed, left = 0, 3600 * given.hours
        for own, seconds in planned:
            left -= seconds
            if left < 0:
                console.print("the other runs do not fit in the hours that are left")
                break
            failed += not driven([*own, *ALWAYS, f"out={given.out}"])
        for name, episodes in publish_worlds(given.out, home).items():
            console.print(f"{name}: {episodes} episodes")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
