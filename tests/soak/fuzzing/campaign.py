"""Fuzzing for a time: each reader gets an equal part of it."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, seed, settings

from tests.soak.fuzzing.readers import READERS, Files, Reader
from tests.soak.fuzzing.trial import Trials, Verdict

ROUND = 200
"""Files of one campaign of Hypothesis: after it the clock is looked at."""
MOST = 20
"""After so many different things that went wrong, a reader is left."""


def tried(reader: Reader, trials: Trials, count: int, number: int) -> list[tuple[Verdict, Files]]:
    """Read so many changed files.

    Nothing is raised, and no smaller file is looked for: a campaign goes on after the first that goes wrong.

    Args:
        reader: the reader.
        trials: its process.
        count: how many.
        number: of the draw: the same files for the same number.
    """
    found: list[tuple[Verdict, Files]] = []

    @seed(number)
    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(reader.files)
    def read(files: Files) -> None:
        found.append((trials.tried(files), files))

    read()
    return found


def fuzz(minutes: float, only: Sequence[str] = (), number: int = 0, keep: Path | None = None) -> Iterator[str]:
    """Fuzz the readers, and yield a line about each, with what went wrong below it.

    Args:
        minutes: how long, all readers together.
        only: names of readers; all if there is none.
        number: of the first draw.
        keep: a folder for the files that go wrong.
    """
    chosen = [reader for name, reader in READERS.items() if not only or name in only]
    for reader in chosen:
        counts = dict.fromkeys(("read", "refused", "crashed", "wrong"), 0)
        wrong: dict[str, str] = {}
        with Trials(reader.read, reader.refusals, guarded=reader.guarded) as trials:
            if (valid := trials.tried(reader.valid())).kind != "read":
                wrong[""] = f"the valid file is not read: {valid.text}"
            end = time.monotonic() + minutes * 60 / len(chosen)
            while time.monotonic() < end and len(wrong) < MOST:
                number += 1
                for verdict, files in tried(reader, trials, ROUND, number):
                    counts[verdict.kind] += 1
                    if verdict.kind == "wrong" and (place := _place(verdict.text)) not in wrong:
                        wrong[place] = verdict.text
                        if keep:
                            _kept(files, keep / f"{reader.name} {len(wrong)}")
        yield f"{reader.name}: {sum(counts.values())} files, " + ", ".join(
            f"{count} {kind}" for kind, count in counts.items()
        )
        yield from wrong.values()


def _place(text: str) -> str:
    """Where something went wrong: the last place of a traceback, or what was said, without the numbers of the file."""
    places = [line for line in text.splitlines() if line.strip().startswith("File ")]
    return places[-1] if places else re.sub(r"\d+|'.*'", "0", text)[:60]


def _kept(files: Files, folder: Path) -> None:
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
