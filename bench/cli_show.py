"""`bench show` and `bench view`: what a results folder holds, what made it, and its recordings."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench import registry, results
from bench.errors import UserError

Report = Callable[[str, pa.Table], None]


def print_run(run: str, out: Path, console: Console, report: Report) -> None:
    """Print the configuration and the provenance of every pair of a run, its table and its recordings.

    Args:
        run: a results folder, or the beginning of the name of a pair in `out`.
        out: results folder.
        console: where to print.
        report: prints a table by its name, from records.

    Raises:
        UserError: if there is no such run.
    """
    folder, pair = _located(run, out)
    records = results.read(folder)
    pairs = records.filter(pc.field("sees"))
    if pair:
        pairs = records.filter(pc.field("pair") == _pair(pair, records))
        records = _with_controls(pairs, records)
    for name in pc.unique((pairs if pairs.num_rows else records)["pair"]).to_pylist():
        _print_pair(records.filter(pc.field("pair") == name), console)
    report("run", records)
    found = _recordings(folder, None if not pair else pairs["pair"][0].as_py())
    for path in found:
        console.print(Text(f"recording: bench view {path}"), soft_wrap=True)


def open_recording(run: str, out: Path, console: Console) -> None:
    """Open a recording in the rerun viewer, or say how to where there is no display.

    Args:
        run: a recording; or a results folder or the beginning of a pair's name, whose only recording is opened.
        out: results folder to look for a pair in.
        console: where to print.

    Raises:
        UserError: if there is no recording, or more than one to choose from.
    """
    path = Path(run)
    if not path.is_file():
        folder, pair = _located(run, out)
        found = _recordings(folder, _pair(pair, results.read(folder)) if pair else None)
        if not found:
            raise UserError(f"{run} has no recordings; bench run … record=1 with another out= makes some")
        if len(found) > 1:
            console.print(Text(f"{run} has {len(found)} recordings; open one of them:"))
            for path in found:
                console.print(Text(f"bench view {path}"), soft_wrap=True)
            return
        path = found[0]
    if path.suffix != ".rrd":
        raise UserError(f"{path} is not a recording (.rrd)")
    if not _has_display():
        console.print(Text(f"There is no display here. Where there is one: rerun {path.resolve()}"), soft_wrap=True)
        return
    subprocess.Popen([sys.executable, "-m", "rerun", str(path)], start_new_session=True)
    console.print(Text(f"opened {path} in the rerun viewer"), soft_wrap=True)


def _located(run: str, out: Path) -> tuple[Path, str]:
    """The results folder and the beginning of a pair's name; the name is empty if `run` is a folder."""
    return (Path(run), "") if Path(run).is_dir() else (out, run)


def _pair(beginning: str, records: pa.Table) -> str:
    """The one pair whose name begins so."""
    known = sorted(set(records["pair"].to_pylist()))
    found = [name for name in known if name.startswith(beginning)]
    if len(found) == 1:
        return found[0]
    if found:
        raise UserError(f"{beginning!r} is the beginning of {len(found)} pairs: {', '.join(found)}")
    raise UserError(registry.unknown(f"pair {beginning!r}", beginning, known))


def _with_controls(pairs: pa.Table, records: pa.Table) -> pa.Table:
    """A pair's records with its clean control and the reference drivers of its world."""
    same = {name: pairs[name][0].as_py() for name in ("world", "world_params")}
    victim = ("victim", "victim_params", "defense", "defense_params")
    own = {name: pairs[name][0].as_py() for name in victim}
    world = pc.scalar(True)
    for name, value in same.items():
        world = world & (pc.field(name) == value)
    clean = pc.field("attack") == "none"
    for name, value in own.items():
        clean = clean & (pc.field(name) == value)
    asked = pc.field("pair") == pairs["pair"][0].as_py()
    return records.filter(asked | (world & (clean | ~pc.field("sees"))))


def _print_pair(records: pa.Table, console: Console) -> None:
    """The configuration and the provenance of one pair, a line a fact."""
    first: dict[str, Any] = records.slice(0, 1).to_pylist()[0]
    console.print(Text(first["pair"], style="bold"))
    facts = Table.grid(padding=(0, 2, 0, 0))
    facts.add_column(style="dim", no_wrap=True)
    facts.add_column()
    for kind in registry.KINDS:
        params = ", ".join(f"{key}={value}" for key, value in json.loads(first[f"{kind}_params"]).items())
        facts.add_row(kind, Text(f"{first[kind]}  {params}  ({first[f'{kind}_shipped_by']})"))
    facts.add_row(
        "threat",
        f"{first['threat_norm']} {first['threat_budget']:g}, access {first['threat_access']}, "
        f"{first['threat_queries']} queries a step",
    )
    seeds = records["seed"].to_pylist()
    facts.add_row("grid", f"{first['grid']}: {_cells(records)}, scenario seeds {min(seeds)} to {max(seeds)}")
    facts.add_row("training seeds", _listed(records["training_seed"]))
    facts.add_row("weights", _listed(records["weights_sha256"], 12) or "none")
    facts.add_row("code", _listed(records["code_digest"], 12))
    for libraries in pc.unique(records["libraries"]).to_pylist():
        facts.add_row("libraries", ", ".join(f"{name} {version}" for name, version in json.loads(libraries).items()))
    facts.add_row("machine", _listed(records["machine"]))
    created = pc.min_max(records["created_at"])
    units = records.group_by("unit").aggregate([("wall_s", "max")])
    wall = pc.sum(units["wall_s_max"]).as_py()
    facts.add_row(
        "made", f"{created['max']}, {units.num_rows} units, {records.num_rows} episodes, {wall:.0f} s of work"
    )
    console.print(facts, highlight=False)
    console.print()


def _cells(records: pa.Table) -> str:
    """`lanes 3, 4; density 1, 2; weather clear, rain`."""
    axes = ("lanes", "density", "weather")
    return "; ".join(f"{axis} {_listed(records[axis])}" for axis in axes)


def _listed(column: pa.ChunkedArray, digits: int | None = None) -> str:
    values: Iterable[Any] = sorted(set(column.to_pylist()))
    return ", ".join(f"{value:g}" if isinstance(value, float) else str(value)[:digits] for value in values)


def _recordings(folder: Path, pair: str | None) -> list[Path]:
    return sorted((folder / "recordings").glob(f"{pair or '*'}/*.rrd"))


def _has_display() -> bool:
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
