"""`bench view`: opens a recording, replays and records the episode of any record, or saves a film of it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pyarrow as pa
import pyarrow.compute as pc
from rich.text import Text

from cavbench.cli.as_json import recordings
from cavbench.cli.show import located, pair_named, records_of
from cavbench.errors import UserError
from cavbench.files import check_folder
from cavbench.isolation import tree
from cavbench.scenarios.axes import written
from cavbench.terminal import Console

LOCAL = "127.0.0.1"
"""The web viewer is offered to this machine only."""
STARTS_S = 30.0
"""Seconds within which the web viewer must answer."""
GUARD = """
import os, signal, subprocess, sys, threading

def end():
    sys.stdin.buffer.read()
    os.killpg(0, signal.SIGKILL)

viewer = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL)
threading.Thread(target=end, daemon=True).start()
sys.exit(viewer.wait())
"""
"""Starts the viewer, and ends it with itself when its standard input closes: as soon as its parent is gone, also by kill -9."""


def open_recording(run: str, where: Sequence[str], out: Path, console: Console, *, web: bool = False) -> None:
    """Open a recording in the rerun viewer; without a display, print the commands that open it.

    Args:
        run: a recording, a results folder, or the beginning of a pair's name; several recordings are listed.
        where: `column=value` options; the first matching record is replayed and recorded.
        out: results folder of the pair.
        console: console to print to.
        web: whether to serve rerun's web viewer on this machine until Ctrl-C.

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
    if web:
        _serve(path, console)
        return
    if not _has_display():
        console.print(
            Text(
                f"No display found. `bench view {path} --web` opens it in a browser, --save clip.gif writes a film; "
                f"on a machine with a display, run: rerun {path.resolve()}"
            ),
            soft_wrap=True,
        )
        return
    with tree.ours():
        subprocess.Popen([sys.executable, "-m", "rerun", str(path)], start_new_session=True)
    console.print(Text(f"opened {path} in the rerun viewer"), soft_wrap=True)


def save_film(
    runs: Sequence[str],
    where: Mapping[str, str],
    out: Path,
    console: Console,
    path: Path,
    seconds: str | None,
) -> None:
    """Replay an episode of each run, the same scenario for all, and save them as one film.

    Args:
        runs: recordings, or beginnings of the names of pairs in `out`.
        where: values by column of the first record; the others are of the same cell, scenario and training seed.
        out: results folder of the pairs.
        console: console to print to.
        path: file of the film.
        seconds: the part to show, `FROM:TO`; None for all.

    Raises:
        UserError: if there is no such record, or the film cannot be written.
    """
    from cavbench.recording.film import KINDS, save, stacked
    from cavbench.run.replay import film

    if path.suffix.lower() not in KINDS:
        raise UserError(f"--save {path}: the name must end in {', '.join(KINDS)}")
    part = _seconds(seconds)
    films, wanted = [], dict(where)
    for run in runs:
        folder, record = _record(run, out, wanted)
        made, differences = film(folder, record)
        if differences:
            differing = ", ".join(differences)
            console.print(Text(f"{record['pair']}: the replay differs from the record in {differing}.", style="yellow"))
        films.append(made)
        wanted = {name: str(record[name]) for name in ("cell", "seed")}
    save(stacked(films), path, seconds=part)
    console.print(Text(f"saved {path} ({path.stat().st_size / 1e6:.1f} MB)"), soft_wrap=True)


def _record(run: str, out: Path, wanted: Mapping[str, str]) -> tuple[Path, dict[str, Any]]:
    """The results folder and the record of a recording, or of a pair's first episode with these values."""
    from cavbench.run.replay import find, recorded

    path = Path(run)
    if path.is_file():
        if path.suffix != ".rrd" or not (path.parents[2] / "episodes").is_dir():
            raise UserError(f"{path} is not a recording in a results folder: the film is made from its record there")
        (_, records), *_ = records_of(path.parents[2], path.parent.name)
        return path.parents[2], recorded(path.parents[2], path, records)
    folder, beginning = located(run, out)
    (_, records), *_ = records_of(folder, beginning)
    known = pc.unique(records["pair"]).to_pylist()
    if not beginning and len(known) > 1:
        raise UserError(f"{folder} has {len(known)} pairs: name one of {', '.join(sorted(known))} with --out {folder}")
    return folder, find(records, {"pair": pair_named(beginning, records), **wanted})


def _seconds(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        first, last = (float(part) for part in text.split(":"))
    except ValueError:
        raise UserError(f"--seconds takes FROM:TO, for instance 0:12, got {text}") from None
    return first, last


def _serve(path: Path, console: Console) -> None:
    """Serve a recording and rerun's web viewer on this machine, until Ctrl-C, or whatever else ends this process."""
    import rerun as rr

    ports = {"grpc": _free_port(), "web": _free_port()}
    command = [sys.executable, "-m", "rerun", "--serve-web", "--bind", LOCAL, "--port", str(ports["grpc"])]
    server = subprocess.Popen(
        [sys.executable, "-c", GUARD, *command, "--web-viewer-port", str(ports["web"]), str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    source = f"rerun+http://{LOCAL}:{ports['grpc']}/proxy"
    address = f"http://{LOCAL}:{ports['web']}/?url={quote(source, safe='')}"
    try:
        _await(server, ports["web"])
        console.print(Text(f"rerun {rr.__version__} shows it at {address} (Ctrl-C ends it)"), soft_wrap=True)
        server.wait()
    except KeyboardInterrupt:
        pass
    finally:
        # `python -m rerun` starts the viewer as a process of its own.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(server.pid, signal.SIGKILL)
        server.wait()


def _await(server: subprocess.Popen[bytes], port: int) -> None:
    """Wait until the viewer answers.

    Raises:
        UserError: if it ends before.
    """
    until = time.monotonic() + STARTS_S
    while time.monotonic() < until:
        if server.poll() is not None:
            assert server.stderr is not None
            said = server.stderr.read().decode(errors="replace").strip().splitlines()
            raise UserError(f"rerun's web viewer did not start: {said[-1] if said else server.returncode}")
        with contextlib.suppress(OSError), socket.create_connection((LOCAL, port), timeout=1):
            return
        time.sleep(0.1)
    raise UserError(f"rerun's web viewer did not start within {STARTS_S:.0f} s")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOCAL, 0))
        return int(probe.getsockname()[1])


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
    from cavbench.run.replay import find, replay

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
