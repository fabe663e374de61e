"""Measures what attacks on defended victims cost, and writes the table that `bench run` estimates with:

    python benchmarks/costs.py                        # every row of ROWS and WORLDS
    python benchmarks/costs.py dqn+shield yolov5      # these rows
    python benchmarks/costs.py dqn --attacks pgd zo   # these attacks of a row; what is known of the others stays
    python benchmarks/costs.py merge highway-v0       # these worlds

The table is `bench/run/costs.json` (`cavbench.run.cost`), in CPU seconds of one thread. Each attack drives a small and a large
batch in one cell, only the first `DECISIONS` where the length of episodes is known. What they took is a cost of each step of the
longest episode and a cost of each step of every episode. `batch` is the first one for all steps that an episode can have,
`episode` the second one for a mean episode. `length` is the mean length of an episode, as a share of all steps: that of the
published records, or else what the table says; a pair that neither has drives a batch to the end. `alone` is 1 where the units of
the pair cannot be driven together. What is prepared is measured with little effort.
"""

from __future__ import annotations

import argparse
import gc
import json
import resource
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from cavbench.core import registry
from cavbench.core.pair import Pair, choose
from cavbench.driving import DrivingFacts
from cavbench.driving.drive import drive, drive_jointly
from cavbench.driving.meter import Columns
from cavbench.driving.rollout import rollout
from cavbench.errors import UserError
from cavbench.files import whole
from cavbench.isolation.framework import Snapshot
from cavbench.leaderboard.published import every_track
from cavbench.run.attempt import attempt
from cavbench.run.config import plan_of
from cavbench.run.cost import effort
from cavbench.run.cost import table as costs
from cavbench.run.process import settle
from cavbench.run.task import Outcome, Task
from cavbench.run.unit import Unit

TABLE = Path(__file__).parents[1] / "bench" / "run" / "costs.json"
FEW = ("noise", "pgd", "zo")
PATCHES = ("none", "grey_patch", "noise_patch", "eot")
ROWS = {
    "dqn": ("none", *FEW, "bias", "plan", "rehearse", "pessimist", "two_stage", "paad", "sarsa"),
    "blind": ("none",),
    "random": ("none",),
    "idm": ("none",),
    "clairvoyant": ("none",),
    "planner": ("none", *FEW),
    **dict.fromkeys(("ddpg", "ppo", "sac"), ("none", *FEW)),
    **{f"dqn+{name}": ("none", *FEW) for name in ("advtrain", "atla", "car", "sa", "tracker", "frame_stack")},
    **{
        f"dqn+{name}": ("none", *FEW, "plan", "rehearse", "pessimist")
        for name in ("pessimist_q", "shield", "tracker+shield", "smoothing")
    },
    **{name: (*PATCHES, "square_patch") if name == "yolov5" else PATCHES for name in ("yolov5", "yolov3_tiny")},
    **dict.fromkeys(("fcos", "rcnn"), PATCHES),
    **{f"yolov5+{name}": PATCHES for name in ("jpeg", "median", "temporal", "advtrain_detection")},
    **{f"yolov3_tiny+{name}": PATCHES for name in ("masking", "segmenter")},
}
WORLDS = (
    *("highway", "merge", "highway-v0", "highway-fast-v0"),
    *("roundabout", "intersection", "exit", "two_way", "racetrack", "u_turn", "recorded", "platoon"),
    *("sumo", "sumo_crossing"),
)
DETECTORS = ("yolov5", "yolov3_tiny", "fcos", "rcnn")
DRIVEN, DETECTED, SLOW, SLOW_S = (2, 40), (1, 3), 6, 8.0
"""Episodes of the two batches on each track; and of the second one if the first took longer than so many seconds."""
DECISIONS = 30
"""The first decisions of an episode cost as much as the others."""
WORDS = {
    "eot": ("attack.steps=15",),
    "square_patch": ("attack.steps=20",),
    "plan": ("threat.access=dynamics",),
    "rehearse": ("threat.access=dynamics",),
}
"""What an attack needs more: the right to use the dynamics, or little effort, because crafting is long."""


def measured(words: Sequence[str], framework: Snapshot, cells: Sequence[str]) -> dict[str, float]:
    """The CPU seconds of a pair: of what is prepared, of a batch, and of each episode in it, at the default effort."""
    plan = plan_of((*words, *cells, "seeds=0", "reference=false", f"episodes={max(DRIVEN)}", "record=0"))
    unit = next(one for one in plan.units() if one.pair.id == plan.pairs[0].id)
    times = effort(unit.pair.attack.component)
    found, artefacts = {}, {}
    if unit.artefact:
        outcome, seconds = _timed(Task(unit=unit, step="prepare"), framework)
        found["artefact"], artefacts = seconds / times, {unit.artefact: outcome.artefact or b""}
        times = 1.0
    driving = unit.track.name == "driving"
    sizes, steps = DETECTED if not driving else DRIVEN, getattr(unit.pair.world.component, "max_steps", 1)
    length = _length(unit.pair) if driving else None
    if driving and length is None and unit.pair.world.name == "highway":
        length = float(_batch(unit, DRIVEN[0] * 3, artefacts, framework, cut=False)[0].mean()) / steps
    # What is made once, such as kernels and a road for SUMO, is no cost of a batch.
    _batch(unit, 1, artefacts, framework, cut=length is not None)
    few, seconds = _batch(unit, sizes[0], artefacts, framework, cut=length is not None)
    larger = sizes[1] if seconds < SLOW_S else SLOW
    many, more = _batch(unit, larger, artefacts, framework, cut=length is not None)
    per_step, per_row = _costs([few, many], [seconds, more])
    length = length or float(many.mean()) / steps
    found |= {"batch": per_step * steps / times, "episode": per_row * length * steps / times}
    if driving:
        found["length"] = length
        with _cut_short(1):
            jobs = [replace(unit.job, attack_seed=seed, seeds=unit.seeds[:1]) for seed in range(2)]
            if drive_jointly(jobs) is None:
                found["alone"] = 1.0
    return {name: float(f"{value:.3g}") for name, value in found.items()}


def _cut_short(decisions: int) -> AbstractContextManager[object]:
    """Episodes end after so many decisions, which no user of the benchmark may choose."""

    def short(*given: Any, facts: DrivingFacts, **more: Any) -> Columns:
        return rollout(*given, facts=replace(facts, max_steps=min(decisions, facts.max_steps)), **more)

    return patch("cavbench.driving.drive.rollout", short)


def _length(pair: Pair) -> float | None:
    """The mean length of an episode of a pair, as a share of all steps; None if it is not known, or of another world."""
    if pair.world.name != "highway":
        return None
    victim, defense = pair.victim.name, pair.defense.name
    row = victim if defense == "none" else f"{victim}+{defense}"
    if steps := lengths().get((row, pair.attack.name)):
        return steps / pair.world.component.max_steps
    return costs()["driving"]["rows"].get(row, {}).get(pair.attack.name, {}).get("length")


@cache
def lengths() -> dict[tuple[str, str], float]:
    """The mean steps of an episode in the published records, by row and attack: over all cells, at the default parameters."""
    table = every_track()["driving"].select(["victim", "defense", "attack", "attack_params", "steps"])
    means = table.group_by(table.column_names[:-1]).aggregate([("steps", "mean")]).to_pylist()
    return {
        (one["victim"] if one["defense"] == "none" else f"{one['victim']}+{one['defense']}", one["attack"]): one[
            "steps_mean"
        ]
        for one in means
        if _is_default(one["attack"], one["attack_params"])
    }


def _is_default(attack: str, params: str) -> bool:
    given = json.loads(params or "{}")
    try:
        own = json.loads(choose("attack", attack).params)
    except UserError:
        return False
    return all(given.get(name, value) == value for name, value in own.items())


def _batch(
    unit: Unit, episodes: int, artefacts: Mapping[str, bytes], framework: Snapshot, *, cut: bool
) -> tuple[Any, float]:
    """The steps of some of the episodes of a unit, which are driven in a batch, and the seconds that this takes."""
    part = replace(unit, seeds=unit.seeds[:episodes])
    if not cut:
        outcome, seconds = _timed(Task(unit=part, artefacts=artefacts), framework)
        return _steps(outcome), seconds
    start = time.process_time()
    with _cut_short(DECISIONS):
        steps = drive(part.job, ()).columns["steps"]
    return steps, time.process_time() - start


def _timed(task: Task, framework: Snapshot) -> tuple[Outcome, float]:
    start = cpu()
    outcome = attempt(task, lambda *_: None, framework)
    if outcome.failed:
        raise UserError(outcome.why)
    # A world that is not collected yet has simulations that run.
    gc.collect()
    return outcome, cpu() - start


def cpu() -> float:
    """CPU seconds of this process and of the processes that it has started and that have ended, such as those of SUMO."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _costs(steps: Sequence[Any], seconds: Sequence[float]) -> tuple[float, float]:
    """The seconds of a step of a batch, and of a step of an episode, from what batches with so many steps took."""
    longest, total = np.array([one.max() for one in steps]), np.array([one.sum() for one in steps])
    per_step, per_row = np.linalg.solve(np.stack([longest, total], 1), np.array(seconds))
    if per_row < 0 or per_step < 0:
        per_row = max(per_row, 0.0) and seconds[-1] / total[-1]
        per_step = 0.0 if per_row else seconds[-1] / longest[-1]
    return float(per_step), float(per_row)


def _steps(outcome: Outcome) -> Any:
    """The steps of the episodes of a batch; 1 for each of an image."""
    assert outcome.records is not None
    if "steps" not in outcome.records.column_names:
        return np.ones(outcome.records.num_rows)
    return outcome.records["steps"].to_numpy()


def row_of(name: str, attacks: Sequence[str], framework: Snapshot) -> dict[str, dict[str, float]]:
    """The costs of attacks on a row."""
    victim, _, defense = name.partition("+")
    cells = ("lanes=3",) if victim in DETECTORS else ("lanes=4", "density=1", "weather=clear")
    words = (f"victim={victim}", f"defense={defense or 'none'}")
    found: dict[str, dict[str, float]] = {}
    for attack in attacks:
        start = time.process_time()
        try:
            found[attack] = measured((*words, f"attack={attack}", *WORDS.get(attack, ())), framework, cells)
        except UserError as error:
            print(f"{name} {attack}: {error}", flush=True)
            continue
        print(f"{name} {attack}: {found[attack]}, {time.process_time() - start:.0f} CPU s", flush=True)
    return found


def world_of(name: str, framework: Snapshot) -> dict[str, float]:
    """What a victim that computes nothing costs in a world; and how long episodes of `dqn` are, where it was trained there."""
    cells = ("lanes=4", "density=1", "weather=clear") if name.startswith("highway") else ()
    found = measured((f"world={name}", "victim=idm", "attack=none"), framework, cells)
    del found["length"]
    for attack, column in (("none", "length"), ("pgd", "attacked")):
        try:
            plan = plan_of((f"world={name}", "victim=dqn", f"attack={attack}", *cells, "seeds=0", "reference=false"))
            unit = next(one for one in plan.units() if one.pair.id == plan.pairs[0].id)
        except UserError as error:
            print(f"{name} {attack}: {error}", flush=True)
            break
        steps, _ = _batch(unit, DRIVEN[0] * 3, {}, framework, cut=False)
        found[column] = float(f"{steps.mean() / unit.pair.world.component.max_steps:.3g}")
    print(name, found, flush=True)
    return found


def main() -> None:
    """The command of this module."""
    parser = argparse.ArgumentParser(description="Measure the costs that bench run estimates with.")
    parser.add_argument("names", nargs="*", help="rows or worlds; without any, all")
    parser.add_argument("--attacks", nargs="+", help="of the rows, whose others stay; without any, all")
    given = parser.parse_args()
    names = given.names or [*ROWS, *WORLDS]
    if unknown := [name for name in names if name not in (*ROWS, *WORLDS)]:
        parser.error(f"no row or world is called {', '.join(unknown)}; there are {', '.join((*ROWS, *WORLDS))}")
    settle()
    registry.load("attack", "pgd")
    framework = Snapshot()
    for name in names:
        if name in WORLDS:
            track, place, found = "driving", "worlds", world_of(name, framework)
        else:
            track = "detection" if name.partition("+")[0] in DETECTORS else "driving"
            place, found = "rows", row_of(name, given.attacks or ROWS[name], framework)
        # Read again: another process may measure other rows.
        table = json.loads(TABLE.read_text())
        known = table[track].setdefault(place, {})
        known[name] = {**known.get(name, {}), **found} if given.attacks else found
        with whole(TABLE) as file:
            file.write((json.dumps(table, indent=1, sort_keys=True) + "\n").encode())


if __name__ == "__main__":
    main()
