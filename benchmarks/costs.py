"""Computes what attacks on defended victims cost, and writes the table that `bench run` estimates with:

    python benchmarks/costs.py                   # from the published records
    python benchmarks/costs.py RESULTS           # renews what a results folder has measured
    python benchmarks/costs.py --overheads       # measures what a batch costs beside its episodes, too: a CPU minute

Every record has the wall time of its unit, a share of that of its batch, in a worker with one thread. The table is
`bench/run/costs.json` (`cavbench.run.cost`): for each attack on each defended victim the median seconds an episode, for the
default effort of the attack, and of a patch the seconds of its crafting.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from statistics import median

import pyarrow as pa

from cavbench.core import registry
from cavbench.core.pair import choose
from cavbench.errors import UserError
from cavbench.files import whole
from cavbench.isolation.framework import Snapshot
from cavbench.leaderboard.published import every_track
from cavbench.records import reading
from cavbench.run.attempt import attempt
from cavbench.run.config import plan_of
from cavbench.run.cost import effort
from cavbench.run.process import settle
from cavbench.run.task import Task

TABLE = Path(__file__).parents[1] / "bench" / "run" / "costs.json"
CELL = ("lanes=4", "density=1", "weather=clear", "seeds=0", "reference=false")
SMALL, LARGE = 2, 10
"""Episodes of the two batches whose difference is the cost of an episode."""
SIDES = {"plain": ("defense=advtrain",), "filtered": ("defense=tracker+shield",)}
"""Defended victims that do not crash, so that all episodes of a batch are equally long."""


def measured(records: pa.Table) -> dict[str, dict[str, dict[str, float]]]:
    """By defended victim and attack, the seconds of an episode and of what is prepared, at the default effort."""
    columns = ["victim", "defense", "attack", "attack_params", "unit", "wall_s"]
    crafting = "crafting_s" in records.column_names
    columns += ["crafting_s"] if crafting else []
    units: dict[tuple[str, ...], list[dict[str, float]]] = defaultdict(list)
    for row in records.select(columns).to_pylist():
        name = row["victim"] if row["defense"] == "none" else f"{row['victim']}+{row['defense']}"
        units[name, row["attack"], row["attack_params"], row["unit"]].append(row)
    found: dict[tuple[str, str], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for (name, attack, params, _), rows in units.items():
        if (times := _effort(attack, params)) is None:
            continue
        own = found[name, attack]
        own["episode"].append(rows[0]["wall_s"] / len(rows) / (1.0 if crafting else times))
        if crafting and rows[0]["crafting_s"]:
            own["artefact"].append(rows[0]["crafting_s"] / times)
    table: dict[str, dict[str, dict[str, float]]] = {}
    for (name, attack), costs in sorted(found.items()):
        table.setdefault(name, {})[attack] = {kind: float(f"{median(values):.3g}") for kind, values in costs.items()}
    return table


def _effort(attack: str, params: str) -> float | None:
    """The effort of the parameters of a record; None if this version has no such attack."""
    try:
        return effort(choose("attack", attack, **json.loads(params or "{}")).component)
    except (UserError, ValueError):
        return None


def overhead(words: tuple[str, ...], framework: Snapshot) -> float:
    """What a batch costs beside its episodes, in episodes: CPU time of pgd, in this process."""
    small, large = (
        _driven((*words, *CELL, "attack=pgd", "attack.steps=1", f"episodes={count}"), framework)
        for count in (SMALL, LARGE)
    )
    episode = (large - small) / (LARGE - SMALL)
    print(f"{' '.join(words)}: {SMALL} episodes {small:.1f} s, {LARGE} episodes {large:.1f} s")
    return float(f"{max(small / episode - SMALL, 0):.2g}")


def _driven(words: tuple[str, ...], framework: Snapshot) -> float:
    plan = plan_of(words)
    unit = next(one for one in plan.units() if one.pair.id == plan.pairs[0].id)
    start = time.process_time()
    outcome = attempt(Task(unit=unit), lambda *_: None, framework)
    if outcome.failed:
        raise UserError(outcome.why)
    return time.process_time() - start


def main() -> None:
    """The command of this module."""
    parser = argparse.ArgumentParser(description="Write the table of costs that bench run estimates with.")
    parser.add_argument("folder", type=Path, nargs="?", help="results folder; without one the published records")
    parser.add_argument("--overheads", action="store_true", help="measure what a batch costs beside its episodes, too")
    words = parser.parse_args()
    table = json.loads(TABLE.read_text()) if TABLE.exists() else {}
    sources: Mapping[str, pa.Table] = reading.read_all(words.folder) if words.folder else every_track()
    for name, records in sources.items():
        known = table.setdefault(name, {"overhead": {"plain": 0.0, "filtered": 0.0}, "rows": {}})
        for row, costs in measured(records).items():
            known["rows"].setdefault(row, {}).update(costs)
    if words.overheads:
        settle()
        registry.load("attack", "pgd")
        framework = Snapshot()
        table["driving"]["overhead"] = {name: overhead(side, framework) for name, side in SIDES.items()}
    with whole(TABLE) as file:
        file.write((json.dumps(table, indent=1, sort_keys=True) + "\n").encode())


if __name__ == "__main__":
    main()
