"""A results folder with something of everything that a leaderboard can show."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from cavbench.records.store import FOLDER
from tests.leaderboard.synthetic import CLEAR, approach, baseline_drivers, drive, probed

SEEN = {"redrawn": 0.0, "same_answer": 0.2}
PGD = {"queries": 45.0, "gradient_queries": 44.0, "zero_gradients": 0.0}


def driving() -> pa.Table:
    """Two victims, three defences, three attacks, two budgets, two efforts, one more effort on two cells only."""
    skills = {
        ("dqn", "none"): (0.75, 0.25),
        ("dqn", "advtrain"): (0.7, 0.5),
        ("ddpg", "none"): (0.6, 0.3),
        ("dqn", "masked"): (0.7, 0.6),
    }
    tables = [baseline_drivers(episodes=20)]
    for (victim, defense), (clean, left) in skills.items():
        own = {
            "defense": defense,
            "defense_params": {"skip": 0.5} if defense == "advtrain" else {},
            "weights": "ab" * 32,
        }
        tables.append(probed(drive(victim, skill=clean, **own), **SEEN))  # type: ignore[arg-type]
        tables.append(probed(drive(victim, attack="noise", skill=clean - 0.05, **own), gradient_queries=0.0, **SEEN))
        white = left + 0.1 if defense == "masked" else left - 0.05
        tables.append(
            probed(drive(victim, attack="pgd", attack_params={"steps": 10}, skill=white, **own), **PGD, **SEEN)
        )
        for steps, budget, skill in ((4, 0.1, left), (1, 0.1, left + 0.08), (4, 0.05, left + 0.15)):
            zo = drive(victim, attack="zo", attack_params={"steps": steps}, skill=skill, threat=("relative", budget),
                       queries=11.0 * steps, **own)  # fmt: skip
            name = f"zo-{defense}-{victim}" + ("" if (steps, budget) == (4, 0.1) else f"-{steps}-{budget}")
            tables.append(probed(zo, pair=name, gradient_queries=0.0, **SEEN))
    longer = drive(
        attack="pgd", attack_params={"steps": 30}, skill=0.15, queries=125.0, weights="ab" * 32, cells=CLEAR[:2]
    )
    return pa.concat_tables([*tables, probed(longer, pair="pgd-none-dqn-30", **PGD, **SEEN)])


def detection() -> pa.Table:
    """A detector with and without a defence, under a patch and its controls."""
    tables = []
    for defense, left in (("none", 0.1), ("advtrain_detection", 0.7)):
        tables.append(approach(0.9, defense=defense))
        tables += [approach(left, attack="eot", defense=defense), approach(0.75, attack="noise_patch", defense=defense)]
        tables.append(approach(0.8, attack="grey_patch", defense=defense))
    return probed(pa.concat_tables(tables), average_precision=0.83, false_stops=0.27)


def write(out: Path) -> Path:
    """Both tracks, a file each, and one recording."""
    folder = out / FOLDER
    folder.mkdir(parents=True)
    for name, records in (("driving", driving()), ("detection", detection())):
        pq.write_table(records, folder / f"{name}.parquet")
    recording = out / "recordings" / "zo-none-dqn" / "3-lanes-density-1-clear-1000000.rrd"
    recording.parent.mkdir(parents=True)
    recording.write_bytes(b"RRF2")
    return out
