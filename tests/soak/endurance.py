"""A long run, with an eye on the memory and the open files of its processes."""

from __future__ import annotations

import time
from pathlib import Path

import psutil

from cavbench.records.packing import units_in
from tests.command import started
from tests.soak.subjects import RUN

LONG = [word for word in RUN if not word.startswith(("seeds=", "attack.pause="))]
SEEDS = 1_000
"""As many training seeds as a run takes."""


def endure(site: Path, out: Path, minutes: float) -> str:
    """Drive units for so many minutes, and compare memory and open files of all processes early and late.

    The first fifth is the start; means of the second and of the last fifth are compared.
    """
    # More units than it can drive: the run is stopped by the clock.
    seeds = ",".join(map(str, range(SEEDS)))
    process = started(site, *LONG, f"seeds={seeds}", "attack.pause=0.01", f"out={out}")
    samples: list[tuple[float, float, int]] = []
    begin = time.monotonic()
    while (now := time.monotonic() - begin) < minutes * 60 and process.poll() is None:
        try:
            family = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
            memory = sum(member.memory_info().rss for member in family) / 1e6
            samples.append((now, memory, sum(member.num_fds() for member in family)))
        except psutil.NoSuchProcess:
            continue
        time.sleep(1)
    ended = process.poll()
    process.kill()
    _, err = process.communicate()
    if ended is not None:
        return f"it ended too early, with exit code {ended}: {err.strip().splitlines()[-1:]}"
    units = len(set().union(*map(units_in, out.glob("episodes/*.parquet"))))
    parts = [[s for s in samples if low <= s[0] / (minutes * 60) < low + 0.2] for low in (0.2, 0.8)]
    (early, files), (late, later_files) = [
        (sum(s[1] for s in part) / max(len(part), 1), max((s[2] for s in part), default=0)) for part in parts
    ]
    return (
        f"{minutes:g} minutes, {units} units: memory {early:.0f} MB early, {late:.0f} MB late; "
        f"open files at most {files} early, {later_files} late"
    )
