"""A process with all that it started: what they use together, and their end. Linux only; elsewhere a process counts alone.

A descendant in a session of its own, whose parents have ended, stays a descendant, because a worker adopts orphans (`adopt`).
"""

from __future__ import annotations

import ctypes
import os
import signal
import stat
import sys
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

# By name: a plug-in could replace or delete what a module has.
from time import monotonic, sleep

PR_SET_CHILD_SUBREAPER = 36
"""Parameter of Linux' prctl(2)."""
LEFT_S = 1.0
"""Seconds that processes may take to end after what held them is closed."""
ROUNDS = 20
"""How often what is left of a tree is killed: a process may start another one meanwhile."""
MEMORY = ("/dev/shm/", "/memfd:", "/SYSV")
"""Beginnings of the names of files that lie in memory."""


@dataclass(frozen=True)
class Identity:
    """A process that no later one can be mistaken for: its number, and when it started."""

    number: int
    start: str

    def kill(self) -> None:
        """End it, if it is there."""
        if _start(self.number) == self.start:
            with suppress(ProcessLookupError, PermissionError):
                os.kill(self.number, signal.SIGKILL)


OURS: set[Identity] = set()
"""What the framework itself started. It ends by itself, or is meant to stay, as a viewer is."""


@contextmanager
def ours() -> Iterator[None]:
    """What this process starts in this context is the framework's own: `end_what_is_left` leaves it alone."""
    before = identities(os.getpid())
    try:
        yield
    finally:
        OURS.update(identities(os.getpid()) - before)


def identities(process: int) -> set[Identity]:
    """The descendants of a process."""
    return {Identity(one, start) for one in descendants(process) if (start := _start(one))}


def adopt() -> None:
    """Become the parent of all descendants whose own parents end."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def descendants(process: int) -> list[int]:
    """The processes that a process started, with those that they started; empty where that cannot be read."""
    found: list[int] = []
    waiting = [process]
    while waiting:
        own: list[int] = []
        for listed in Path(f"/proc/{waiting.pop()}/task").glob("*/children"):
            with suppress(OSError):
                own += [int(number) for number in listed.read_text().split()]
        found += own
        waiting += own
    return found


def used_bytes(process: int, folder: Path | None = None) -> int:
    """The memory of a process and its descendants in bytes; 0 if that cannot be read.

    Memory that several of them share counts once. Files in memory count also if no process has them mapped, as long as one of
    them has them open.

    Args:
        process: its number.
        folder: of temporary files, which count, too.
    """
    others = descendants(process)
    files = _open_files([process, *others], MEMORY)
    temporary = 0
    if folder:
        # A file without a name is in no folder.
        nameless = [size for size, links in _open_files([process, *others], (f"{folder}/",)).values() if not links]
        temporary = folder_bytes(folder) + sum(nameless)
    if not others and not files:
        return resident_bytes(process) + temporary
    own, shared = 0, 0
    for one in (process, *others):
        parts = _shares(one)
        # A process can hide its parts from others of its user, but not how much it has.
        own += parts.get("Pss") or resident_bytes(one)
        shared += parts.get("Pss_Shmem", 0)
    return max(own, resident_bytes(process)) + max(0, sum(size for size, _ in files.values()) - shared) + temporary


def resident_bytes(process: int) -> int:
    """The physical memory of a process in bytes; 0 if that cannot be read."""
    try:
        pages = Path(f"/proc/{process}/statm").read_text().split()[1]
    except (OSError, IndexError):
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def folder_bytes(folder: Path) -> int:
    """What the files in a folder take on the disk, in bytes; links are not followed."""
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):
                total += os.lstat(os.path.join(place, name)).st_blocks * 512
    return total


def kill(process: int) -> None:
    """End the descendants of a process that is its own reaper, wherever they are; then the process itself."""
    _kill_descendants(process)
    with suppress(ProcessLookupError, PermissionError):
        os.kill(process, signal.SIGKILL)


def end_what_is_left(*used: int) -> list[str]:
    """End the descendants of this process that would outlive it, but not the framework's own (`ours`).

    Call it last: files are closed, because some programs end as soon as nobody has the other end of a pipe.

    Args:
        used: descriptors of this process that stay open, beside its standard streams.

    Returns:
        The programs that had to be killed, in alphabetical order.
    """
    own, deadline = os.getpid(), monotonic() + LEFT_S
    if not _living(own, but=OURS):
        return []
    for number in [int(name) for name in os.listdir("/proc/self/fd")]:
        if number > 2 and number not in used:
            with suppress(OSError):
                os.close(number)
    while (living := _living(own, but=OURS)) and monotonic() < deadline:
        sleep(0.01)
    names = sorted({name for one in living if (name := _program(one.number))})
    _kill_descendants(own, but=OURS)
    return names


def _kill_descendants(process: int, but: Collection[Identity] = ()) -> None:
    for _ in range(ROUNDS):
        living = _living(process, but)
        if not living:
            break
        for one in living:
            one.kill()


def _living(process: int, but: Collection[Identity] = ()) -> list[Identity]:
    return [one for one in identities(process) - set(but) if not _is_zombie(one.number)]


def _program(process: int) -> str:
    """What a process runs; empty if it is not there."""
    try:
        return Path(f"/proc/{process}/comm").read_text().strip()
    except OSError:
        return ""


def _is_zombie(process: int) -> bool:
    return _facts(process)[:1] in ([], ["Z"])


def _start(process: int) -> str:
    """When a process started, in ticks of the clock; empty if it is not there."""
    facts = _facts(process)
    return facts[19] if len(facts) > 19 else ""


def _facts(process: int) -> list[str]:
    """The fields of proc(5)'s stat from the third on; none if the process is not there."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2].split()
    except OSError:
        return []


def _shares(process: int) -> dict[str, int]:
    """The proportional memory of a process in bytes: what n processes share counts as an n-th of each."""
    found = {}
    with suppress(OSError, ValueError, IndexError):
        for line in Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()[1:]:
            name, _, rest = line.partition(":")
            found[name] = int(rest.split()[0]) * 1024
    return found


def _open_files(processes: Sequence[int], beginnings: tuple[str, ...]) -> dict[tuple[int, int], tuple[int, int]]:
    """The sizes and numbers of names of files that processes have open, by device and number, of those in some places."""
    found: dict[tuple[int, int], tuple[int, int]] = {}
    for process in processes:
        with suppress(OSError):
            for entry in os.scandir(f"/proc/{process}/fd"):
                with suppress(OSError):
                    if os.readlink(entry.path).startswith(beginnings):
                        about = os.stat(entry.path)
                        if stat.S_ISREG(about.st_mode):
                            found[about.st_dev, about.st_ino] = about.st_blocks * 512, about.st_nlink
    return found
