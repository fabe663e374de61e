"""What the records of a pair say was driven, and whether every identifying column is what this pair gives here.

A record names its pair in a dozen columns. They are not believed: the pair is made from them, its units are planned as
`bench run` plans them, and each column is compared with what these units would write.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cavbench.core import registry
from cavbench.core.device import recorded
from cavbench.core.device import stated as stated_device
from cavbench.core.pair import IN_PROCESS, Pair
from cavbench.errors import UserError, message, short
from cavbench.identity.fingerprint import canonical
from cavbench.records import reading
from cavbench.records.schema import AUDIT, SEQUENTIAL
from cavbench.run.plan import Plan
from cavbench.run.replay import pair_of
from cavbench.run.unit import Unit
from cavbench.scenarios import Cell, Grid, SeedBlock

OF_THE_PAIR = (
    "pair",
    *(f"{kind}{suffix}" for suffix in ("", "_params", "_shipped_by") for kind in registry.KINDS),
    "action_type",
    "sees",
    *(f"threat_{name}" for name in ("norm", "budget", "access", "queries", "share")),
    "world_facts",
)
"""Columns with one value in all records of a pair."""
OF_THE_DRIVER = ("code_digest", "libraries", "machine", "created_at", "wall_s")
"""Columns that say by what, where and when it was driven: they differ where the pair is driven again."""


@dataclass(frozen=True, kw_only=True)
class Claim:
    """What records say was driven.

    Args:
        pair: the pair.
        plan: the run that drives it again, with its clean control and its baselines.
    """

    pair: Pair
    plan: Plan


def of(units: Sequence[pa.Table]) -> Claim:
    """The claim of the records of a pair.

    Args:
        units: the records of each unit.

    Raises:
        UserError: if they are not of one pair that others can load, or not of a whole grid that a run drives.
    """
    records = pa.concat_tables(units)
    for name in OF_THE_PAIR:
        if len(values := pc.unique(records[name]).to_pylist()) > 1:
            raise UserError(
                f"the records differ in {name}, which a pair has once: {short(str(values[0]))} and {short(str(values[1]))}"
            )
    first = records.slice(0, 1).to_pylist()[0]
    _check_loadable(first)
    _check_imports(first)
    try:
        pair = pair_of(first)
    except (UserError, ValueError, TypeError) as error:
        raise UserError(
            f"the columns {', '.join(OF_THE_PAIR[1:])} of the records make no pair: {message(error)}"
        ) from None
    if pair.id != first["pair"]:
        raise UserError(
            f"the records name the pair {short(first['pair'])}, but the columns {', '.join(OF_THE_PAIR[1:])} make it {pair.id}"
        )
    grid = _grid(units, records, pair)
    seeds = tuple(sorted(set(records["training_seed"].to_pylist())))
    try:
        plan = Plan(pairs=(pair,), grid=grid, seeds=seeds, record=0, device=recorded(first["machine"]))
    except ValueError as error:
        raise UserError(f"the records are of no run: {error}") from None
    if not pair.is_seeded and seeds != (0,):
        raise UserError(f"the records have the training_seed {max(seeds)}; {pair} has none, which is written as 0")
    wanted = {(seed, cell, block) for seed in seeds for cell in plan.cells(pair) for block in grid.blocks()}
    given = [_key(unit) for unit in units]
    if len(set(given)) < len(given) or set(given) != wanted:
        odd = next(iter(set(given) - wanted or wanted - set(given)), given[0])
        raise UserError(
            f"the training_seed, cell and seed of the records are not a whole grid, once ({len(given)} units, {len(wanted)} "
            f"expected; for instance {odd[1]}, training seed {odd[0]}, scenarios {odd[2].start} to {odd[2].stop - 1}): drive "
            "every combination of the values on its axes, into a folder of its own"
        )
    return Claim(pair=pair, plan=plan)


def _check_loadable(first: Mapping[str, Any]) -> None:
    """Refuse what others cannot load, and what would read a file of whoever checks it."""
    for kind in registry.KINDS:
        if first[f"{kind}_shipped_by"] == IN_PROCESS or _names_a_file(json.loads(first[f"{kind}_params"])):
            raise UserError(
                f"{kind} {first[kind]!r} exists on your machine only: ship it as a plug-in that others can install, with its "
                "weights as safetensors (bench new victim, docs/submit.md)"
            )


def _names_a_file(params: Any) -> bool:
    """Whether parameters, also those of the links of a chain, name a file."""
    inner = params.values() if isinstance(params, dict) else params if isinstance(params, list) else ()
    return bool(isinstance(params, dict) and params.get("path")) or any(map(_names_a_file, inner))


def _check_imports(record: Mapping[str, Any]) -> None:
    """Refuse a world that would import a module which the sender names.

    Raises:
        UserError: names the module.
    """
    params = json.loads(record["world_params"])
    if isinstance(params, dict) and (module := registry.load("world", record["world"]).imports(params)):
        raise UserError(
            f"the records are of a world that imports the module {short(module)}, which no plug-in of cavbench is: nobody can "
            "verify them without running it; register the environment as a world of a package (GymWorld)"
        )


def _grid(units: Sequence[pa.Table], records: pa.Table, pair: Pair) -> Grid:
    """The grid that records are of: the values on its axes, and its blocks of seeds."""
    world = pair.world.component
    grids = set(records["grid"].to_pylist())
    if AUDIT in grids or max(records["seed"].to_pylist()) >= SeedBlock.AUDIT:
        raise UserError("the column grid or seed is of an audit: its scenarios are in no score")
    try:
        cells = [world.axes.cell(**json.loads(text)) for text in pc.unique(records["cell"]).to_pylist()]
        values = {axis: tuple(dict.fromkeys(cell[axis] for cell in cells)) for axis in world.axes}
        blocks = sorted({_block(unit) for unit in units}, key=lambda block: (block.start, block.stop))
        own = world.own_grid()
        starts = {grid.first_seed for grid in (registry.grids(pair.world.name) if own is None else [own])}
        if blocks[0].start not in starts:
            known = " or ".join(map(str, sorted(starts)))
            raise UserError(
                f"the seed of the first record is {blocks[0].start}, scenarios of world {pair.world.name!r} begin at {known}"
            )
        return Grid(
            name=SEQUENTIAL if grids == {SEQUENTIAL} else "submitted",
            world=pair.world.name,
            axes=world.axes,
            values=values,
            episodes=blocks[-1].stop - blocks[0].start,
            first_seed=blocks[0].start,
            block=len(blocks[0]),
        )
    except (ValueError, TypeError, OverflowError) as error:
        raise UserError(f"the cell and seed of the records are no grid of world {pair.world.name!r}: {error}") from None


def _block(unit: pa.Table) -> range:
    """The scenario seeds of a unit, which must be in their order."""
    seeds = unit["seed"].to_pylist()
    block = range(seeds[0], seeds[0] + len(seeds))
    if seeds != list(block):
        raise UserError(
            f"the seed of the records of unit {short(_one(unit, 'unit'))} is not one after the other, in order"
        )
    return block


def _key(unit: pa.Table) -> tuple[int, Cell, range]:
    return _one(unit, "training_seed"), Cell(**json.loads(_one(unit, "cell"))), _block(unit)


def _one(unit: pa.Table, name: str) -> Any:
    """The value of a column of a unit, which must have one."""
    values = unit[name].to_pylist()
    if any(canonical(value) != canonical(values[0]) for value in values[1:]):
        raise UserError(f"the records of a unit differ in {name}, which a unit has once")
    return values[0]


def checked(claimed: Mapping[str, pa.Table], units: Sequence[Unit]) -> dict[str, Unit]:
    """The unit of each claimed one, by the fingerprint that its records have.

    Args:
        claimed: the records by unit.
        units: those of the pair, with the weights that were loaded here.

    Raises:
        UserError: names the first record and the column that is not what its unit writes.
    """
    planned = {(unit.training_seed, unit.cell, unit.seeds): unit for unit in units}
    found = {}
    for key, records in claimed.items():
        if (unit := planned.get(_key(records))) is None:
            raise UserError(f"the record {short(key)} is of no unit of the pair")
        for name, why in _wrong(key, records, unit):
            raise UserError(f"the record {key[:16]}… has a wrong {name}: {why}")
        found[key] = unit
    return found


def _wrong(key: str, records: pa.Table, unit: Unit) -> Iterator[tuple[str, str]]:
    """The columns of a unit's records that are not what the unit writes, and why."""
    constants = unit.constants(0.0)
    for name, wanted in constants.items():
        given = _one(records, name)
        if name not in (*OF_THE_DRIVER, "unit") and given != wanted:
            yield name, f"it is {short(str(given))}, the pair gives {short(str(wanted))}"
    noun = unit.track.artefact[0] if unit.track.artefact else ""
    artefact = _one(records, noun) if noun else ""
    if bool(artefact) != bool(unit.artefact) or not re.fullmatch("([0-9a-f]{64})?", artefact):
        yield noun, f"it is {short(artefact)}, which is no {noun} of this pair"
    code, libraries, machine = (_one(records, name) for name in ("code_digest", "libraries", "machine"))
    if not re.fullmatch("[0-9a-f]{64}", code):
        yield "code_digest", f"it is {short(code)}, which is no sha256"
    here, there = unit.libraries, json.loads(libraries)
    if canonical(there) != libraries or there.keys() != here.keys():
        yield "libraries", f"it is {short(libraries)}, not canonical JSON of the versions of {', '.join(sorted(here))}"
    if not all(isinstance(version, str) for version in there.values()):
        yield "libraries", "a version is no text"
    if _one(records, "created_at") > datetime.now(UTC) + reading.SKEW:
        yield "created_at", "it is in the future"
    if not machine.isprintable() or not 0 < len(machine) <= LONGEST_MACHINE:
        yield "machine", f"it is {short(machine)}, which is no printable text of at most {LONGEST_MACHINE} characters"
    if _one(records, "unit") != key:
        yield "unit", f"it is {short(_one(records, 'unit'))}"
    wanted = unit.fingerprint_with(code=code, libraries=there, device=stated_device(machine), artefact=artefact)
    if key != wanted:
        yield (
            "unit",
            f"it is {key[:16]}…, the pair, training_seed, cell, seeds, code_digest, libraries and device of machine give "
            f"{wanted[:16]}…",
        )


LONGEST_MACHINE = 400


def invalid_floats(records: pa.Table) -> str:
    """The first column with a NaN, which our records never hold (what is not measured is null); empty if none."""
    for name, column in zip(records.column_names, records.columns, strict=True):
        flat = column.combine_chunks()
        flat = flat.flatten() if pa.types.is_list(flat.type) else flat
        if pa.types.is_floating(flat.type) and np.isnan(flat.drop_null().to_numpy(zero_copy_only=False)).any():
            return name
    return ""


def check_weights(out: Path, units: Sequence[Unit], records: pa.Table | None) -> None:
    """Refuse units that would stand in for records of the same pair with other weights.

    Raises:
        UserError: names the pair.
    """
    if records is None:
        return
    rows = records.select(["pair", "training_seed", "weights_sha256"]).group_by(
        ["pair", "training_seed", "weights_sha256"]
    )
    there: dict[tuple[str, int], set[str]] = {}
    for row in rows.aggregate([]).to_pylist():
        there.setdefault((row["pair"], row["training_seed"]), set()).add(row["weights_sha256"])
    for unit in units:
        others = there.get((unit.pair.id, unit.training_seed), set()) - {unit.weights_sha256}
        if others:
            raise UserError(
                f"{out} has records of {unit.pair.id}, training seed {unit.training_seed}, with other weights "
                f"({min(others)[:12]}… there, {unit.weights_sha256[:12] or 'none'}… in the submission): "
                "choose another folder with out="
            )
