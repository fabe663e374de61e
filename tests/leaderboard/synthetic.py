"""Records that a run could have left, made up: valid in every column, shaped by a skill a driver."""

from __future__ import annotations

import json
from collections.abc import Iterable
from datetime import UTC, datetime

import numpy as np
import pyarrow as pa

from bench.results import SCHEMA
from bench.scenario import GRIDS, Cell

CLEAR = tuple(cell for cell in GRIDS["standard-v1"].cells() if cell.weather == "clear")


def drive(
    victim: str = "dqn",
    *,
    attack: str = "none",
    attack_params: dict[str, object] | None = None,
    defense: str = "none",
    defense_params: dict[str, object] | None = None,
    victim_params: dict[str, object] | None = None,
    threat: tuple[str, float] = ("relative", 0.1),
    cells: Iterable[Cell] = GRIDS["standard-v1"].cells(),
    runs: Iterable[int] = (0, 1, 2),
    episodes: int = 20,
    skill: float = 0.6,
    sees: bool = True,
    action_type: str = "discrete",
    grid: str = "standard-v1",
    queries: float = 0.0,
) -> pa.Table:
    """Records of one (attack, defence, victim); `skill` in [0, 1] sets how far it gets and how seldom it crashes."""
    cells = tuple(cells)
    run, place, seed = (
        axis.ravel() for axis in np.meshgrid(tuple(runs), range(len(cells)), range(episodes), indexing="ij")
    )
    lanes, density = (np.array([getattr(cell, name) for cell in cells])[place] for name in ("lanes", "density"))
    weather = np.array([cell.weather for cell in cells])[place]
    attacked = attack != "none"
    generator = np.random.default_rng([ord(letter) for letter in victim + attack + defense])
    count = len(run)
    at_cell = skill - 0.12 * (density - 1) - 0.05 * (weather != "clear") + 0.03 * np.sin(7 * run + len(victim))
    at_cell = np.clip(at_cell, 0, 1)
    crashed = generator.random(count) > at_cell + 0.25
    steps = np.where(crashed, generator.integers(30, 450, count), 450)
    speed = 20 + 10 * at_cell
    columns: dict[str, object] = {
        "unit": "0" * 64,
        "pair": f"{attack}-{defense}-{victim}",
        "attack": attack,
        "attack_params": json.dumps(attack_params or {}, sort_keys=True),
        "defense": defense,
        "defense_params": json.dumps(defense_params or {}, sort_keys=True),
        "victim": victim,
        "victim_params": json.dumps(victim_params or {}, sort_keys=True),
        "world": "highway",
        "world_params": '{"preset": "standard"}',
        "action_type": action_type,
        "sees": sees,
        "training_seed": run,
        "threat_norm": threat[0],
        "threat_budget": threat[1] if attacked else 0.0,
        "threat_access": "scores",
        "threat_queries": 1000,
        "grid": grid,
        "lanes": lanes,
        "density": density,
        "weather": weather,
        "seed": 1_000_000 + seed,
        "steps": steps,
        "return": steps * (0.67 + 0.3 * at_cell),
        "safe_progress": np.where(crashed, 0, np.clip(at_cell + generator.normal(0, 0.08, count), 0, 1)),
        "crashed": crashed,
        "offroad": False,
        "distance_m": steps / 15 * speed,
        "min_ttc_s": np.where(generator.random(count) < 0.1, np.inf, generator.gamma(2, 1, count)),
        "mean_speed": speed,
        "queries": queries,
        "queries_median": queries,
        "queries_max": queries * 1.2,
        "changed": generator.beta(5, 3, count) * attacked,
        "linf": 0.05 * attacked,
        "linf_max": 0.1 * attacked,
        "l2": 0.1 * attacked,
        "linf_m": 4.2 * attacked,
        "linf_mps": 1.1 * attacked,
        "excess_max": 0.0,
        "attack_ms": 0.02 * queries,
        "action_counts": [[n, 0, 0, 0, 0] if action_type == "discrete" else [] for n in steps],
        "created_at": datetime(2026, 1, 1, tzinfo=UTC),
        "wall_s": 1.0,
    }
    arrays = []
    for field in SCHEMA:
        value = columns.get(field.name, "")
        arrays.append(pa.array(value if isinstance(value, list | np.ndarray) else [value] * count, field.type))
    return pa.table(arrays, schema=SCHEMA)


def reference_drivers(cells: Iterable[Cell] = CLEAR, episodes: int = 20) -> pa.Table:
    """The reference rows that every run leaves: blind policies, random and IDM, in clear weather."""
    common = {"cells": tuple(cells), "runs": (0,), "episodes": episodes, "sees": False}
    blind = {"slower": 0.2, "idle": 0.05, "right_then_slower": 0.35, "faster": 0.0}
    return pa.concat_tables(
        [
            *(drive("blind", victim_params={"policy": name}, skill=skill, **common) for name, skill in blind.items()),
            drive("random", skill=0.02, **common),
            drive("idm", skill=0.7, **common),
        ]
    )
