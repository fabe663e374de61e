"""Records that a run could have left, made up: valid in every column, shaped by a skill a driver."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pyarrow as pa
import pytest

from cavbench.core import registry
from cavbench.core.contracts import Facts
from cavbench.core.pair import choose
from cavbench.core.track import track
from cavbench.envs.camera.axes import APPROACH_V1
from cavbench.envs.highway.axes import STANDARD_V2
from cavbench.records.schema import schema
from cavbench.scenarios import Cell, Grid
from cavbench.statistics.episodes import as_text

FEATURES = {"names": ["x", "vx"], "units": ["m", "m/s"], "floors": [0.5, 0.3]}
GRID = replace(STANDARD_V2, name="synthetic-v1", episodes=20, block=0, training_seeds=3)
"""The standard cells with fewer trainings and scenarios, so that whole tables are made in no time."""


@contextmanager
def grid_is_known() -> Iterator[None]:
    """While it lasts, `GRID` is one of the grids of its world, as if a plug-in had brought it."""
    known = registry.grids
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "grids", lambda world: [*known(world), *[GRID] * (world == GRID.world)])
        yield


CLEAR = tuple(cell for cell in GRID.cells() if cell.weather == "clear")


def drive(
    victim: str = "dqn",
    *,
    attack: str = "none",
    attack_params: dict[str, object] | None = None,
    defense: str = "none",
    defense_params: dict[str, object] | None = None,
    victim_params: dict[str, object] | None = None,
    threat: tuple[str, float] = ("relative", 0.1),
    cells: Iterable[Cell] = GRID.cells(),
    runs: Iterable[int] = (0, 1, 2),
    episodes: int = 20,
    skill: float = 0.6,
    sees: bool = True,
    action_type: str = "discrete",
    grid: str = GRID.name,
    queries: float = 0.0,
    weights: str = "",
) -> pa.Table:
    """Records of one (attack, defence, victim); `skill` in [0, 1] sets how far it gets and how seldom it crashes."""
    cells = tuple(cells)
    run, place, seed = (
        axis.ravel() for axis in np.meshgrid(tuple(runs), range(len(cells)), range(episodes), indexing="ij")
    )
    density = np.array([cell.density for cell in cells])[place]
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
        "unit": units(
            attack, attack_params, defense, defense_params, victim, victim_params, threat, run=run, place=place
        ),
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
        "threat_share": 1.0,
        "grid": grid,
        "cell": [as_text(cells[i]) for i in place],
        "world_facts": facts(GRID, features=FEATURES, decision_hz=15, max_steps=450),
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
        "weights_sha256": weights,
        "action_counts": [[n, 0, 0, 0, 0] if action_type == "discrete" else [] for n in steps],
        "created_at": datetime(2026, 1, 1, tzinfo=UTC),
        "wall_s": 1.0,
    }
    return table(schema(track("driving")), columns, count)


def probed(records: pa.Table, **columns: float | str) -> pa.Table:
    """The same records with what a run measures for flags; a column it has already is replaced."""
    for name, value in columns.items():
        if name not in records.column_names:
            records = records.append_column(name, pa.nulls(records.num_rows, pa.float64()))
        field = records.schema.field(name)
        values = pa.array([value] * records.num_rows, field.type)
        records = records.set_column(records.schema.get_field_index(name), field, values)
    return records


def units(*identity: object, run: np.ndarray, place: np.ndarray) -> list[str]:
    """A fingerprint a unit: a pair, a training seed and a cell."""
    return [hashlib.sha256(repr((identity, *key)).encode()).hexdigest() for key in zip(run, place, strict=True)]


def facts(grid: Grid, **more: object) -> str:
    """What records say of the world of a grid."""
    return json.dumps({**Facts(axes=grid.axes).written(), **more})


def table(schema: pa.Schema, columns: Mapping[str, object], count: int) -> pa.Table:
    """Records of a schema; a column that is not given is empty, one value is that of every record."""
    arrays = []
    columns = {"libraries": "{}", **columns}
    for field in schema:
        value = columns.get(field.name, None if field.nullable else "")
        arrays.append(pa.array(value if isinstance(value, list | np.ndarray) else [value] * count, field.type))
    return pa.table(arrays, schema=schema)


LOCATIONS = ("sun-behind-ego", "sun-beside", "sun-behind-sign")


def approach(
    left: float | Callable[[str, str], float],
    victim: str = "yolov3_tiny",
    *,
    attack: str = "none",
    changes: Mapping[str, object] | None = None,
    defense: str = "none",
    victim_params: Mapping[str, object] | None = None,
    world_params: Mapping[str, object] | None = None,
    budget: float = 0.5,
    cells: Iterable[Cell] = APPROACH_V1.cells(),
    runs: Iterable[int] = (0, 1, 2),
) -> pa.Table:
    """Records of one patch, an approach a location and cell; `left` is the confidence it leaves, by weather and location."""
    cells, runs = tuple(cells), tuple(runs) if attack not in ("none", "grey_patch") else (0,)
    run, place, seed = (axis.ravel() for axis in np.meshgrid(runs, range(len(cells)), range(3), indexing="ij"))
    weather = [cells[i].weather for i in place]
    location = [LOCATIONS[(1_000_000 + i) % 3] for i in seed]
    expected = np.array([left(*where) if callable(left) else left for where in zip(weather, location, strict=True)])
    generator = np.random.default_rng([*(ord(letter) for letter in victim + attack), round(1000 * budget)])
    confidence = np.clip(expected + generator.normal(0, 0.01, len(run)) + 0.01 * np.sin(7 * run), 0, 1)
    frames = [[float(value)] * 10 for value in confidence]
    attacked = attack != "none"
    columns: dict[str, object] = {
        "unit": units(attack, changes, defense, victim, victim_params, budget, run=run, place=place),
        "pair": f"{attack}-{defense}-{victim}",
        "attack": attack,
        "attack_params": choose("attack", attack, **(changes or {})).params,
        "defense": defense,
        "defense_params": "{}",
        "victim": victim,
        "victim_params": json.dumps(victim_params or {}),
        "world": "camera",
        "world_params": json.dumps(world_params or {"bank": ""}, separators=(",", ":")),
        "sees": True,
        "training_seed": run,
        "threat_norm": "patch",
        "threat_budget": budget if attacked else 0.0,
        "threat_access": "gradients" if attacked else "oblivious",
        "threat_queries": 20_000 if attacked else 0,
        "threat_share": 1.0,
        "grid": "approach-v1",
        "cell": [as_text(cells[i]) for i in place],
        "world_facts": facts(APPROACH_V1),
        "seed": 1_000_000 + seed,
        "location": location,
        "confidence_mean": confidence,
        "confidence_median": confidence,
        "detection_rate": (confidence > 0.25).astype(float),
        "first_seen_m": 30 * confidence,
        "confirmed_m": 25 * confidence,
        "overrun_m": 0.0,
        "ran": confidence < 0.3,
        "visible_share": 1.0,
        "false_alarms": 0.0,
        "queries": 1200.0 * (attack == "eot"),
        "gradients": 1200.0 * (attack == "eot"),
        "crafting_s": 1.0,
        "excess": 0.0,
        "frame_distance_m": [list(np.linspace(30, 8, 10)) for _ in run],
        "frame_confidence": frames,
        "frame_visible": [[1.0] * 10 for _ in run],
        "created_at": datetime(2026, 1, 1, tzinfo=UTC),
        "wall_s": 1.0,
        "stop_score": confidence,
    }
    return table(schema(track("detection")), columns, len(run))


def baseline_drivers(cells: Iterable[Cell] = CLEAR, episodes: int = 20) -> pa.Table:
    """The baselines that every run drives: blind policies, random and IDM, in clear weather."""
    common = {"cells": tuple(cells), "runs": (0,), "episodes": episodes, "sees": False}
    blind = {"slower": 0.2, "idle": 0.05, "right_then_slower": 0.35, "faster": 0.0}
    return pa.concat_tables(
        [
            *(drive("blind", victim_params={"policy": name}, skill=skill, **common) for name, skill in blind.items()),
            drive("random", skill=0.02, **common),
            drive("idm", skill=0.7, **common),
        ]
    )
