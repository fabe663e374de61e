"""Bad places and bad company: a full disk, a folder that cannot be written, two writers, a wrong clock, bad input."""

from __future__ import annotations

import importlib
import math
import os
import pkgutil
import subprocess
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from tempfile import TemporaryFile

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

import cavbench
from cavbench.cli import main as cli
from tests.command import Said, ran, started
from tests.soak.bad_inputs import bad_inputs
from tests.soak.subjects import RUN, SUBJECTS, Condition

NEW_PROCESS = 20
"""One in so many bad inputs also runs in a new process."""


def full_disk(site: Path, place: Path) -> str:
    """A run on a disk that fills up ends with one line; it continues when there is room."""
    with _mounted(place, "size=700k") as works:
        if not works:
            return "skipped: only root may mount a small disk"
        said = ran(site, *RUN, f"out={place}")
        line = said.err.strip().splitlines()[-1]
        kept = len(SUBJECTS["run"].finished(place))
        subprocess.run(["mount", "-o", "remount,size=50m", str(place)], check=True)
        again = ran(site, *RUN, f"out={place}")
        return f"exit code {said.code}, {line!r}, {kept} units kept; with room again: exit code {again.code}"


def read_only(site: Path, place: Path) -> str:
    """A run into a folder that cannot be written ends with one line before any work."""
    with _mounted(place, "size=10m,ro") as works:
        if not works:
            return "skipped: only root may mount a disk"
        said = ran(site, *RUN, f"out={place}")
        return f"exit code {said.code}, {said.err.strip().splitlines()[-1]!r}"


def two_writers(site: Path, place: Path) -> str:
    """Two runs into one folder at once both end well, and the records are those of one."""
    both = [started(site, *RUN, f"out={place / 'both'}") for _ in range(2)]
    codes = [(process.communicate(), process.returncode)[1] for process in both]
    ran(site, *RUN, f"out={place / 'one'}")
    subject = SUBJECTS["run"]
    same = subject.result(place / "both") == subject.result(place / "one")
    return f"exit codes {codes}, records {'equal' if same else 'DIFFERENT'} to those of one writer"


def clock_skew(site: Path, place: Path) -> str:
    """Records of a machine whose clock is a day ahead: the same command drives nothing again, and a report says so."""
    ran(site, *RUN, f"out={place}")
    for path in place.glob("episodes/*.parquet"):
        records = pq.read_table(path)
        column = records.column_names.index("created_at")
        later = pc.add(records["created_at"], pa.scalar(timedelta(days=1)))
        pq.write_table(records.set_column(column, records.schema.field("created_at"), later), path)
    before = SUBJECTS["run"].finished(place)
    again = ran(site, *RUN, f"out={place}")
    driven = sum(content != before.get(name) for name, content in SUBJECTS["run"].finished(place).items())
    told = ran(site, "report", "leaderboard", f"out={place}")
    return (
        f"exit code {again.code}, {driven} of {len(before)} units driven again; "
        f"report: exit code {told.code}, {told.err.strip().splitlines()[-1:]}"
    )


def bad_input(place: Path, count: int) -> str:
    """Every one of so many bad command lines ends with one line and a code other than 0.

    They run in copies of one process that has imported everything; every twentieth also in a new one, which must say the same.
    """
    for module in pkgutil.walk_packages(cavbench.__path__, "cavbench."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    wrong, other = [], 0
    for number, argv in enumerate(bad_inputs(count, seed=0, folder=place)):
        said = _in_a_copy(argv)
        if said.code == 0 or len(said.err.strip().splitlines()) != 1 or "Traceback" in said.err:
            wrong.append(argv)
        if number % NEW_PROCESS == 0:
            other += said != ran(place, *argv)
    return (
        f"{count} bad inputs, {len(wrong)} not refused in one line{f', for instance {wrong[0]}' if wrong else ''}; "
        f"{other} of {math.ceil(count / NEW_PROCESS)} that also ran in a new process said something else there"
    )


def _in_a_copy(argv: Sequence[str]) -> Said:
    """Run the command line in a fork of this process."""
    with TemporaryFile("w+") as out, TemporaryFile("w+") as err:
        child = os.fork()
        if not child:
            code = 1
            try:
                os.environ |= {"OMP_NUM_THREADS": "1", "COLUMNS": "160"}
                os.dup2(out.fileno(), 1)
                os.dup2(err.fileno(), 2)
                sys.argv = ["bench", *argv]
                cli.main()
            except SystemExit as end:
                code = int(end.code or 0)
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
        _, status = os.waitpid(child, 0)
        texts = [(file.seek(0), file.read())[1] for file in (out, err)]
        return Said(os.waitstatus_to_exitcode(status), *texts)


@contextmanager
def _mounted(place: Path, options: str) -> Iterator[bool]:
    """A small disk in memory on a folder; False if this user may not mount one."""
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(place)]
    works = os.geteuid() == 0 and subprocess.run(command, check=False, capture_output=True).returncode == 0
    try:
        yield works
    finally:
        if works:
            subprocess.run(["umount", str(place)], check=True)


CONDITIONS: Mapping[str, Condition] = {
    "full disk": full_disk,
    "read-only folder": read_only,
    "two writers": two_writers,
    "clock a day ahead": clock_skew,
}
