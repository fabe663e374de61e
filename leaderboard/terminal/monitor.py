"""`bench report monitor`: how well the alarms of a monitor tell attacked episodes from others."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from cavbench.core.pair import label
from cavbench.core.track import track
from cavbench.errors import UserError
from cavbench.terminal import Console

KEY = ("world", "world_params", "cell", "seed", "training_seed")
"""What an attacked episode and its clean control have in common."""
VICTIM = ("defense", "defense_params", "victim", "victim_params")


class Watched(NamedTuple):
    """What the alarms of a victim under an attack say.

    Args:
        false_alarms: alarms an hour of driving without an attack.
        seen: share of the attacked episodes with an alarm after the first falsified frame.
        delay_s: median time to that alarm, of the episodes that have one; NaN if none has.
        area: area under the receiver operating characteristic: the chance that an attacked episode is more suspicious than one
            without an attack.
        score: mean score under the attack.
        unseen: the same if an attack that is seen is called off from the start: its episode then counts as without an attack.
        clean: mean score of the same scenarios without an attack.
    """

    false_alarms: float
    seen: float
    delay_s: float
    area: float
    score: float
    unseen: float
    clean: float


def area(attacked: NDArray[np.float64], clean: NDArray[np.float64]) -> float:
    """The area under the ROC of two samples, from their ranks (Mann and Whitney 1947); ties count half."""
    above = (attacked[:, None] > clean).mean()
    return float(above + (attacked[:, None] == clean).mean() / 2)


def watched(
    attacked: Sequence[Mapping[str, object]], clean: Mapping[tuple[object, ...], Mapping[str, object]]
) -> Watched:
    """What the alarms say, from the records of attacked episodes and of their controls by `KEY`."""

    def values(rows: Sequence[Mapping[str, object]], name: str) -> NDArray[np.float64]:
        return np.array([row[name] for row in rows], float)

    both = [(row, clean[key]) for row in attacked if (key := tuple(row[name] for name in KEY)) in clean]
    if not both:
        raise UserError("the attacked episodes have no clean control in these records")
    own, control = [row for row, _ in both], list({id(other): other for _, other in both}.values())
    delays = np.array([np.inf if row["alarm_delay_s"] is None else row["alarm_delay_s"] for row in own], float)
    seen = np.isfinite(delays)
    hours = sum(float(row["steps"]) / json.loads(str(row["world_facts"]))["decision_hz"] for row in control) / 3600  # type: ignore[arg-type]
    scores, without = values(own, "safe_progress"), values([other for _, other in both], "safe_progress")
    return Watched(
        false_alarms=float(values(control, "alarms").sum()) / hours,
        seen=float(seen.mean()),
        delay_s=float(np.median(delays[seen])) if seen.any() else np.nan,
        area=area(values(own, "suspicion"), values(control, "suspicion")),
        score=float(scores.mean()),
        unseen=float(np.where(seen, without, scores).mean()),
        clean=float(without.mean()),
    )


def monitor_report(records: Mapping[str, pa.Table], console: Console) -> None:
    """One row for each attacked pair whose victim watches.

    Raises:
        UserError: if no record is of a victim with a monitor.
    """
    rows = [
        row
        for name, table in records.items()
        if "suspicion" in table.column_names and track(name).metric == "safe_progress"
        for row in table.filter(table["suspicion"].is_valid()).to_pylist()
    ]
    if not rows:
        raise UserError(
            "no record is of a victim with a monitor: drive one with `bench run attack=pgd defense=monitor`"
        )
    console.print(_table(rows))
    console.print(
        Text(
            "seen: episodes with an alarm after the first falsified frame. ROC: area under it, 0.5 is chance. "
            "score, unseen: an attack that is seen counts as called off."
        ),
        soft_wrap=True,
    )


def _table(rows: Sequence[Mapping[str, object]]) -> Table:
    clean: dict[tuple[object, ...], dict[tuple[object, ...], Mapping[str, object]]] = {}
    attacked: dict[tuple[object, ...], list[Mapping[str, object]]] = {}
    for row in rows:
        victim = tuple(row[name] for name in VICTIM)
        if row["attack"] == "none":
            clean.setdefault(victim, {})[tuple(row[name] for name in KEY)] = row
        else:
            attack = (*victim, row["attack"], row["attack_params"], row["threat_norm"], row["threat_budget"])
            attacked.setdefault(attack, []).append(row)
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("pair", overflow="fold")
    for heading in ("false\nalarms/h", "seen", "delay\ns", "\nROC", "score", "score,\nunseen", "score,\nno attack"):
        table.add_column(heading, justify="right")
    for key, own in attacked.items():
        found = watched(own, clean.get(key[: len(VICTIM)], {}))
        names = [
            label(kind, str(own[0][kind]), json.loads(str(own[0][f"{kind}_params"])))
            for kind in ("attack", "defense", "victim")
        ]
        table.add_row(
            Text(" + ".join(names)),
            f"{found.false_alarms:.1f}",
            f"{100 * found.seen:.0f} %",
            f"{found.delay_s:.1f}",
            f"{found.area:.2f}",
            f"{found.score:.2f}",
            f"{found.unseen:.2f}",
            f"{found.clean:.2f}",
        )
    return table
