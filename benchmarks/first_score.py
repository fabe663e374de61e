"""Measures how long `bench run` takes to a first score, and how long it takes to refuse a wrong word:

    python benchmarks/first_score.py                       # this checkout, whose `make tree` was run
    python benchmarks/first_score.py ../before/build/tree  # that of another one beside it, round by round

Each command is typed as a user does, into an empty folder, after one that fills the caches. The least of the rounds is
printed, in seconds of wall time: others on the machine make each of them longer, and none shorter.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROUNDS = 3
HERE = Path(__file__).parents[1] / "build" / "tree"
COMMANDS = {
    "one episode": (
        "-m",
        "cavbench",
        "run",
        "attack=pgd",
        "lanes=3",
        "density=1",
        "weather=clear",
        "seeds=0",
        "episodes=1",
    ),
    "a wrong parameter": ("-m", "cavbench", "run", "attack=pgd", "attack.stepz=3"),
    "import cavbench": ("-c", "import cavbench"),
}


def seconds(tree: Path, words: tuple[str, ...]) -> float:
    """The wall time of a command of a checkout in an empty folder."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        subprocess.run(
            [sys.executable, *words],
            cwd=folder,
            env=environment | {"PYTHONPATH": str(tree.resolve())},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        return time.perf_counter() - start


def main() -> None:
    """Print a table."""
    trees = [HERE, *map(Path, sys.argv[1:])]
    print(f"| command | {' | '.join(str(tree.parents[1].resolve().name) for tree in trees)} |")
    print(f"|---|{'---|' * len(trees)}")
    for name, words in COMMANDS.items():
        for tree in trees:
            seconds(tree, words)
        took = [[seconds(tree, words) for tree in trees] for _ in range(ROUNDS)]
        print(f"| {name} | {' | '.join(f'{min(times):.2f} s' for times in zip(*took, strict=True))} |", flush=True)


if __name__ == "__main__":
    main()
