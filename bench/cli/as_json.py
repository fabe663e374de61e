"""What commands say as JSON: the content of reports is found by its entry point, as their tables are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from cavbench import documents
from cavbench.core import registry
from cavbench.run import stops


def report_named(name: str) -> documents.Report:
    """A report that can be written as data.

    Raises:
        UserError: if there is none of this name.
    """
    found: documents.Report = registry.resolve(documents.GROUP, name, "report as data")
    return found


def show_results(
    out: Path, records: Mapping[str, pa.Table], errors: Sequence[str] = (), *, shown: str | None = None
) -> None:
    """Print what was driven as one document.

    Args:
        out: the results folder.
        records: by track.
        errors: what failed, so that units are missing.
        shown: the pair whose stops and recordings are listed; None for all pairs of the records.
    """
    documents.show("run", results(out, records, errors, shown=shown))


def results(
    out: Path, records: Mapping[str, pa.Table], errors: Sequence[str] = (), *, shown: str | None = None
) -> dict[str, Any]:
    """The content of that document."""
    pairs = [shown] if shown else [name for one in records.values() for name in pc.unique(one["pair"]).to_pylist()]
    return {
        **report_named("run").content(records, out),
        "complete": not errors,
        "errors": list(errors),
        "stops": [asdict(stop) | {"by": list(stop.by)} for stop in stops.read(out, pairs)],
        "recordings": [str(path.relative_to(out)) for path in recordings(out, None) if path.parent.name in pairs],
    }


def recordings(folder: Path, pair: str | None) -> list[Path]:
    """The recordings of a pair, or of all pairs."""
    found = sorted((folder / "recordings").glob("*/*.rrd"))
    return [path for path in found if pair in (None, path.parent.name)]
