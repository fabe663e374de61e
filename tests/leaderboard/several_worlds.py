"""Made-up records of several worlds, whose roads are those of the highway."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pyarrow as pa

from tests.leaderboard.synthetic import CLEAR, drive

CELLS = CLEAR[:2]
SEEDS = tuple(range(6))


def scores(victim: str, world: str, mean: float, **about: Any) -> pa.Table:
    """Records of a defended victim in a world whose scores have this mean; `my_world` has no driver with perfect information."""
    records = drive(victim, cells=CELLS, episodes=len(SEEDS), **about)
    generator = np.random.default_rng([ord(letter) for letter in victim + world])
    noise = generator.normal(0, 0.02, records.num_rows)
    drivers = ["agent", "idm", *["clairvoyant"] * (world != "my_world")]
    facts = json.loads(records["world_facts"][0].as_py()) | {"drivers": drivers}
    values = {
        # Units and pairs are hashes of all that they are of, the world too.
        **{name: [f"{one}{world}" for one in records[name].to_pylist()] for name in ("unit", "pair")},
        "world": [world] * records.num_rows,
        "world_params": ["{}"] * records.num_rows,
        "world_facts": [json.dumps(facts)] * records.num_rows,
        "grid": [f"{world}-made-up"] * records.num_rows,
        "safe_progress": np.clip(mean + noise - noise.mean(), 0, 1),
    }
    for name, value in values.items():
        field = records.schema.field(name)
        records = records.set_column(records.schema.get_field_index(name), field, pa.array(value, field.type))
    return records


def attacked(victim: str, world: str, mean: float, attack: str = "pgd", **about: Any) -> list[pa.Table]:
    """A victim under an attack, and without."""
    return [
        scores(victim, world, mean, attack=attack, queries=9.0 * (attack != "noise"), **about),
        scores(victim, world, min(mean + 0.2, 1), **about),
    ]


def references(world: str, blind: float = 0.2, perfect: float | None = 0.9) -> list[pa.Table]:
    alone = {"sees": False, "runs": (0,)}
    found = [scores("blind", world, blind, victim_params={"policy": "idle"}, **alone)]
    return found + ([scores("clairvoyant", world, perfect, **alone)] if perfect is not None else [])
