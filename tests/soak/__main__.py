"""Kills real commands at random moments, continues them, and compares the end with an undisturbed run: `make soak`.

    python -m tests.soak kills=100 inputs=1000 plugins=60 fuzzing=60 minutes=60 seed=0
    python -m tests.soak kills=10 inputs=200 plugins=10 fuzzing=10 minutes=2 only=run,craft

Then come bad places, bad command lines, plug-ins that misbehave (`plugins`), changed files (`fuzzing`: minutes) and a long run
(`minutes`); 0 leaves a part out.
Prints a table of figures. Not part of the test suite.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import psutil

from tests.command import started
from tests.plugins.distributions import install_toy
from tests.soak.conditions import CONDITIONS, bad_input
from tests.soak.endurance import endure
from tests.soak.fuzzing.campaign import fuzz
from tests.soak.rogues import sweep
from tests.soak.subjects import SUBJECTS, Subject

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
GONE_S = 90
"""Seconds that the processes of a killed command may take to end; two of Ray's own need 62 after SIGKILL."""


def kill_and_continue(subject: Subject, kills: int, site: Path, root: Path, draw: random.Random) -> Counter[str]:
    """Kill a command so often, each time at a random moment, and let it end after every third kill.

    Returns:
        Counts: kills by signal, `too late` (it had ended, so this is no kill), and what went wrong.
    """
    counts: Counter[str] = Counter()
    calm = root / "calm"
    seconds = ran(subject, site, calm)
    expected = subject.result(calm)
    done, number = 0, 0
    while done < kills:
        out = root / str(number := number + 1)
        for _ in range(min(3, kills - done)):
            number_of_signal = draw.choice(SIGNALS)
            before, begin = subject.finished(out), time.monotonic()
            killed, left = kill(subject, site, out, number_of_signal, draw.uniform(0.02, 1) * seconds)
            counts["processes left"] += left
            after = subject.finished(out)
            counts["lost"] += sum(after.get(name) != content for name, content in before.items())
            if not killed:
                counts["too late"] += 1
                # A busy machine made the undisturbed run slow: aim earlier.
                seconds = min(seconds, time.monotonic() - begin)
                break
            counts[signal.Signals(number_of_signal).name] += 1
            done += 1
        ran(subject, site, out)
        counts["other result"] += subject.result(out) != expected
        counts["temporary files left"] += len(list(out.rglob(".*.tmp")))
        shutil.rmtree(out)
    return counts


def ran(subject: Subject, site: Path, out: Path) -> float:
    """Run a command to its end, and return its seconds; the harness ends if it fails."""
    out.mkdir(exist_ok=True)
    start = time.monotonic()
    process = started(site, *subject.words(out))
    _, err = process.communicate()
    if process.returncode:
        sys.exit(f"{subject.name} ended with {process.returncode}: {err}")
    return time.monotonic() - start


def kill(subject: Subject, site: Path, out: Path, number: signal.Signals, after: float) -> tuple[bool, int]:
    """Start a command, and send it a signal: whether it was still running, and how many processes it left."""
    out.mkdir(exist_ok=True)
    process = started(site, *subject.words(out))
    until = time.monotonic() + after
    children: dict[int, psutil.Process] = {}
    while time.monotonic() < until and process.poll() is None:
        children |= {child.pid: child for child in psutil.Process(process.pid).children(recursive=True)}
        time.sleep(0.05)
    runs = process.poll() is None
    if runs:
        children |= {child.pid: child for child in psutil.Process(process.pid).children(recursive=True)}
        process.send_signal(number)
    process.communicate()
    left = psutil.wait_procs(list(children.values()), timeout=GONE_S)[1]
    return runs, sum(map(_works, left))


def _works(process: psutil.Process) -> bool:
    """Whether a process has not ended; an orphan that nobody waits for has."""
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def main(words: list[str]) -> None:
    """Run all parts, and print their figures."""
    given = {
        "kills": "100",
        "inputs": "1000",
        "plugins": "60",
        "fuzzing": "60",
        "minutes": "60",
        "seed": "0",
        "only": ",".join(SUBJECTS),
    }
    given |= dict(word.split("=", 1) for word in words)
    with tempfile.TemporaryDirectory() as folder:
        site = Path(folder) / "site"
        site.mkdir()
        install_toy(site)
        show(f"{os.cpu_count()} cores, {os.getloadavg()[0]:.0f} processes waiting")
        kill_all(site, Path(folder), given["only"].split(","), int(given["kills"]), random.Random(int(given["seed"])))
        for name, condition in CONDITIONS.items():
            show(f"{name}: {condition(site, _made(Path(folder) / name))}")
        if count := int(given["inputs"]):
            show(f"bad input: {bad_input(_made(Path(folder) / 'bad input'), count)}")
        if count := int(given["plugins"]):
            show(f"plug-ins: {sweep(_made(Path(folder) / 'plug-ins'), count, int(given['seed']))}")
        for line in fuzz(float(given["fuzzing"]), number=int(given["seed"])) if float(given["fuzzing"]) else ():
            show(line)
        if minutes := float(given["minutes"]):
            show(f"endurance: {endure(site, Path(folder) / 'endurance', minutes)}")
        show(f"{os.getloadavg()[0]:.0f} processes waiting")


def kill_all(site: Path, folder: Path, chosen: list[str], kills: int, draw: random.Random) -> None:
    """Kill each command equally often."""
    share = -(-kills // len(chosen))
    for name in chosen if kills else ():
        say(f"{name}: {share} kills", kill_and_continue(SUBJECTS[name], share, site, _made(folder / name), draw))


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def say(title: str, counts: Counter[str]) -> None:
    """Print a line of figures."""
    wrong = ("lost", "other result", "processes left", "temporary files left")
    signals = ", ".join(f"{name} {count}" for name, count in sorted(counts.items()) if name not in wrong)
    show(f"{title} ({signals}): " + ", ".join(f"{name} {counts[name]}" for name in wrong))


def show(line: str) -> None:
    """Print a line of figures with the time."""
    print(f"{time.strftime('%H:%M')} {line}", flush=True)  # noqa: T201


if __name__ == "__main__":
    main(sys.argv[1:])
