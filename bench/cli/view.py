"""`bench view`: opens a recording, or replays and records the episode of any record."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
from rich.console import Console
from rich.text import Text

from bench.cli.show import located, pair_named, recordings, records_of
from bench.errors import UserError
from bench.files import check_folder
from bench.scenarios.axes import written


def open_recording(run: str, where: Sequence[str], out: Path, console: Console) -> None:
    """Open a recording in the rerun viewer; without a display, print the command that opens it.

    Args:
        run: a recording, a results folder, or the beginning of a pair's name; several recordings are listed.
        where: `column=value` options; the first matching record is replayed and recorded.
        out: results folder of the pair.
        console: console to print to.

    Raises:
        UserError: if there is no such recording or record.
    """
    path = Path(run)
    if not path.is_file():
        folder, beginning = located(run, out)
        found = _replayed(folder, beginning, where, console) if where else _listed(folder, beginning, console)
        if found is None:
            return
        path = found
    if path.suffix != ".rrd":
        raise UserError(f"{path} is not a recording (.rrd)")
    if not _has_display():
        console.print(
            Text(f"No display found. On a machine with a display, run: rerun {path.resolve()}"), soft_wrap=True
        )
        return
    subprocess.Popen([sys.executable, "-m", "rerun", str(path)], start_new_session=True)
    console.print(Text(f"opened {path} in the rerun viewer"), soft_wrap=True)


def _listed(folder: Path, beginning: str, console: Console) -> Path | None:
    """The only recording; None after listing several.

    Raises:
        UserError: if there is no recording.
    """
    (_, records), *_ = records_of(folder, beginning)
    pair = pair_named(beginning, records) if beginning else None
    found = recordings(folder, pair)
    if len(found) == 1:
        return found[0]
    what = f"{pair or folder} has {len(found) or 'no'} recordings"
    if not found:
        raise UserError(f"{what}; record an episode, for instance: {_example(folder, pair, records)}")
    console.print(Text(f"{what}:"))
    for path in found:
        console.print(Text(f"  bench view {path}"), soft_wrap=True)
    console.print(Text(f"Replay any other episode, for instance: {_example(folder, pair, records)}"), soft_wrap=True)
    return None


def _example(folder: Path, pair: str | None, records: pa.Table) -> str:
    first = records.filter(pc.field("pair") == (pair or records["pair"][0])).slice(0, 1).to_pylist()[0]
    where = " ".join(f"{axis}={written(value)}" for axis, value in json.loads(first["cell"]).items())
    return f"bench view {first['pair']} {where} seed={first['seed']} --out {folder}"


def _replayed(folder: Path, beginning: str, where: Sequence[str], console: Console) -> Path:
    from bench.run.replay import find, replay

    (_, records), *_ = records_of(folder, beginning)
    words = dict(word.partition("=")[::2] for word in where)
    if beginning:
        words = {"pair": pair_named(beginning, records)} | words
    record = find(records, words)
    check_folder(folder / "recordings", "the folder of recordings")
    made = replay(folder, record)
    if made.differences:
        cause = f"changed since: {made.changed}" if made.changed else "no known change since"
        differing = ", ".join(made.differences)
        console.print(Text(f"The replay differs from the record in {differing} ({cause}).", style="yellow"))
    else:
        console.print(Text(f"Replayed bit for bit: {record['pair']}, scenario seed {record['seed']}."), soft_wrap=True)
    return made.path


def _has_display() -> bool:
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
