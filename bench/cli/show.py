"""`bench show`: shows the configuration, provenance, table and recordings of a results folder or a pair."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cavbench.cli.as_json import recordings, show_results
from cavbench.core import registry, suites
from cavbench.core.track import Track, track
from cavbench.errors import UserError
from cavbench.records import reading
from cavbench.records.schema import IDENTITY
from cavbench.run import stops
from cavbench.scenarios import Value
from cavbench.scenarios.axes import written

Report = Callable[[Track, pa.Table], None]


def print_run(run: str, out: Path, console: Console, report: Report) -> None:
    """Print the configuration and provenance of the pairs of a run, its table and its recordings.

    Args:
        run: a results folder, or the beginning of the name of a pair in `out`.
        out: results folder.
        console: console to print to.
        report: prints the table of a track, from records.

    Raises:
        UserError: if there is no such folder or pair.
    """
    folder, pair = located(run, out)
    name = None
    for own, records in records_of(folder, pair):
        name = pair_named(pair, records) if pair else None
        shown = records.filter(pc.field("pair") == name if name else pc.field("sees"))
        _print_facts(shown if shown.num_rows else records, console)
        report(own, _with_controls(shown, records, own) if name else records)
        for stop in stops.read(folder, pc.unique(shown["pair"]).to_pylist()):
            console.print(Text(str(stop)), soft_wrap=True)
    for path in recordings(folder, name):
        console.print(Text(f"recording: bench view {path}"), soft_wrap=True)


def show_run(run: str, out: Path) -> None:
    """Print the same as one JSON document (`cavbench.documents`).

    Raises:
        UserError: if there is no such folder or pair.
    """
    folder, pair = located(run, out)
    found, name = {}, None
    for own, records in records_of(folder, pair):
        name = pair_named(pair, records) if pair else None
        found[own.name] = _with_controls(records.filter(pc.field("pair") == name), records, own) if name else records
    show_results(folder, found, shown=name)


def located(run: str, out: Path) -> tuple[Path, str]:
    """The results folder and the beginning of a pair's name, which is empty if `run` is a folder.

    Raises:
        UserError: if `run` is a path that does not exist.
    """
    if Path(run).is_dir():
        return Path(run), ""
    if Path(run) == out and out == Path("results"):
        raise UserError("there is no folder results; create one with `bench run`, or choose another with out=")
    if "/" in run or Path(run) == out:
        raise UserError(f"there is no {'recording' if run.endswith('.rrd') else 'folder'} {run}")
    return out, run


def records_of(folder: Path, pair: str = "") -> list[tuple[Track, pa.Table]]:
    """The records of each track in a folder; only those of the pair's track if a pair's name begins with `pair`."""
    every = [(track(name), records) for name, records in reading.read_all(folder).items()]
    with_pair = [one for one in every if any(name.startswith(pair) for name in pc.unique(one[1]["pair"]).to_pylist())]
    return with_pair[:1] if pair and with_pair else every


def pair_named(beginning: str, records: pa.Table) -> str:
    """The name of the only pair whose name begins so.

    Raises:
        UserError: if there is no such pair, or more than one.
    """
    known = sorted(set(records["pair"].to_pylist()))
    found = [name for name in known if name.startswith(beginning)]
    if len(found) == 1:
        return found[0]
    if found:
        raise UserError(f"{beginning!r} fits {len(found)} pairs: {', '.join(found)}; write more of the name")
    raise UserError(registry.unknown(f"pair {beginning!r}", beginning, known))


def _with_controls(pairs: pa.Table, records: pa.Table, own: Track) -> pa.Table:
    """A pair's records with its clean control and its baselines."""
    identity = [
        field.name for field in IDENTITY if field.name not in ("unit", "pair", "cell", "seed", "training_seed", "grid")
    ]
    pair = pairs.slice(0, 1).to_pylist()[0]
    same = [name for name in identity if name.startswith(("defense", "victim", "world"))]
    kept = {str(pair["pair"])}
    for other in records.group_by([*identity, "pair"]).aggregate([]).to_pylist():
        control = other["attack"] == "none" and all(other[name] == pair[name] for name in same)
        if control or own.baseline_of(other, pair):
            kept.add(str(other["pair"]))
    return records.filter(pc.field("pair").isin(sorted(kept)))


def _print_facts(records: pa.Table, console: Console) -> None:
    """Print the pairs of some records with their configuration and provenance, one line for each distinct value."""
    for name in pc.unique(records["pair"]).to_pylist():
        console.print(Text(name, style="bold"))
    facts = Table.grid(padding=(0, 2, 0, 0))
    facts.add_column(style="dim", no_wrap=True)
    facts.add_column()
    for kind in registry.KINDS:
        facts.add_row(kind, _each(records, (kind, f"{kind}_params", f"{kind}_shipped_by"), _component))
    threat = ("threat_norm", "threat_budget", "threat_access", "threat_queries", "threat_share")
    facts.add_row("threat", _each(records, threat, _threat))
    for line in _suites(records):
        facts.add_row("suite", line)
    facts.add_row("cells", _axes(records["cell"]))
    seeds = pc.min_max(records["seed"]).as_py()
    facts.add_row("scenario seeds", f"{seeds['min']} to {seeds['max']} ({_listed(records['grid'])})")
    facts.add_row("training seeds", _listed(records["training_seed"]))
    facts.add_row("weights", _listed(records["weights_sha256"], 12) or "none")
    facts.add_row("code", _listed(records["code_digest"], 12))
    facts.add_row("libraries", _each(records, ("libraries",), _versions))
    facts.add_row("machine", _each(records, ("machine",), str))
    units = records.group_by("unit").aggregate([("wall_s", "max")])
    facts.add_row(
        "finished",
        f"{pc.max(records['created_at']).as_py():%Y-%m-%d %H:%M} UTC: {records.num_rows} episodes, "
        f"{units.num_rows} units of work, {pc.sum(units['wall_s_max']).as_py():.0f} s",
    )
    console.print(facts, highlight=False)
    console.print()


def _axes(column: pa.ChunkedArray) -> str:
    """The distinct values on each axis."""
    found: dict[str, dict[Value, None]] = {}
    for cell in pc.unique(column).to_pylist():
        for name, value in json.loads(cell).items():
            found.setdefault(name, {})[value] = None
    return "; ".join(f"{name} {', '.join(map(written, values))}" for name, values in found.items())


def _each(records: pa.Table, names: tuple[str, ...], describe: Callable[..., str]) -> Text:
    """One line for each distinct combination of values in these columns."""
    rows = records.select(names).group_by(list(names)).aggregate([]).to_pylist()
    return Text("\n".join(sorted(describe(*(row[name] for name in names)) for row in rows)))


def _suites(records: pa.Table) -> list[str]:
    """The suites of which there is more than one member, with the numbers of their members."""
    rows = records.select(["attack", "attack_params"]).group_by(["attack", "attack_params"]).aggregate([]).to_pylist()
    present = {(row["attack"], row["attack_params"]) for row in rows}
    lines = []
    for name in registry.entries(registry.SUITES):
        members = suites.suite(name).members
        found = sum((member.attack, member.chosen.params) in present for member in members)
        if found > 1:
            lines.append(f"{name}: {found} of {len(members)} members")
    return lines


def _threat(norm: str, budget: float, access: str, queries: int, share: float) -> str:
    frames = "" if share == 1 else f", {100 * share:g} % of the frames"
    return f"{norm} {budget:g}, access {access}, {queries} queries{frames}"


def _component(name: str, params: str, shipped_by: str) -> str:
    values = ", ".join(f"{key}={value}" for key, value in json.loads(params).items())
    return f"{name}({values})  {shipped_by}" if values else f"{name}  {shipped_by}"


def _versions(libraries: str) -> str:
    return ", ".join(f"{name} {version}" for name, version in json.loads(libraries).items())


def _listed(column: pa.ChunkedArray, digits: int | None = None) -> str:
    values: Iterable[Any] = sorted(set(column.to_pylist()))
    return ", ".join(f"{value:g}" if isinstance(value, float) else str(value)[:digits] for value in values)
