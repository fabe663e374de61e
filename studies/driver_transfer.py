"""Drivers trained on one world, scored on all: `python studies/driver_transfer.py [--episodes 10] [--worlds highway merge]`.

Takes `dqn`, `ppo` and `sac` of `highway`, and all that the zoo has of a world of road networks, each with training seed 0.
Drives them without an attack, in clear weather, on all cells of each world's grid with its first seeds. Prints the mean
`safe_progress`. Nothing is recorded.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping

from cavbench import zoo
from cavbench.core import registry
from cavbench.core.pair import choose
from cavbench.driving.victims.selection import selection_score
from cavbench.errors import UserError, in_one_line
from cavbench.run.process import settle
from cavbench.zoo.store import SHIPPED

WORLDS = ("highway", "merge", "roundabout", "intersection", "exit", "two_way", "racetrack", "u_turn")
NAMES = ("dqn", "ppo", "sac")


def main() -> None:
    """Print the table, and a line on the error output for each driver that does not fit a world."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=10, help="episodes a cell")
    parser.add_argument("--worlds", nargs="+", default=WORLDS, choices=WORLDS)
    given = parser.parse_args()
    settle()
    print(f"| driver, trained on | {' | '.join(given.worlds)} |\n{'|---' * (1 + len(given.worlds))}|")
    for name, home, parameters in drivers():
        scores = (_score(name, parameters, world, given.episodes) for world in given.worlds)
        print(f"| `{name}`, {home} | {' | '.join(scores)} |", flush=True)


def drivers() -> Iterator[tuple[str, str, Mapping[str, object]]]:
    """The victim, the world of its training and its parameters, for each driver."""
    for name in NAMES:
        yield name, "highway", {}
    found = {path.parent.name: path for root in (SHIPPED, zoo.own()) for path in sorted(root.glob("*/seed0.json"))}
    for path in found.values():
        recipe = json.loads(path.read_text())["recipe"]
        victim = recipe.get("victim", {})
        home = victim.get("changed", {}).get("trained_in")
        if set(recipe) == {"digest", "victim"} and victim["name"] in NAMES and home in WORLDS:
            yield victim["name"], home, victim["changed"]


def _score(name: str, parameters: Mapping[str, object], world: str, episodes: int) -> str:
    try:
        place = choose("world", world).component
        policy = choose("victim", name, **parameters).component.load(0, place.facts)
        first = registry.grid_of(place).first_seed
        return f"{selection_score(policy, place, episodes, first=first)['mean']:.2f}"
    except UserError as error:
        print(f"{name} {dict(parameters)} in {world}: {error}", file=sys.stderr)
        return "does not fit"


if __name__ == "__main__":
    with in_one_line():
        main()
