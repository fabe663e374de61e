"""Where the rows of a run with `until=` stopped, and which were dropped from a race: a file each in the results folder."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from cavbench import bounded, files
from cavbench.errors import UserError

FOLDER = "stops"


@dataclass(frozen=True)
class Stop:
    """Where a row stopped, and what was known then.

    Args:
        pair: name of the pair.
        why: `narrow`, `ruled out`, `grid done`, `failed` or `raced out`.
        by: for a pair that was ruled out, the pairs that were stronger in its cells; for one that was raced out, those that
            went on.
        until: half the width of the interval that was asked for; None in a race.
        scenarios: scenarios driven in each cell.
        most: scenarios of the grid in each cell.
        estimate: mean of the ranking metric over training seeds, cells and scenarios.
        low, high: bounds of the mean over all scenarios, for these trained victims; valid at every look together with 95 %. Of
            a pair that was raced out, the 95 % interval of the pilot, for other trainings, too.
    """

    pair: str
    why: str
    by: tuple[str, ...]
    until: float | None
    scenarios: int
    most: int
    estimate: float
    low: float
    high: float

    def __str__(self) -> str:
        by = " and ".join(self.by)
        said = {
            "narrow": "known closely enough",
            "ruled out": f"ruled out by {by}",
            "raced out": f"dropped: {by} lowered the score more in all cells together",
        }
        return (
            f"{self.pair}: {self.estimate:.3f} ({self.low:.3f} to {self.high:.3f}) after {self.scenarios} of {self.most} "
            f"scenarios a cell, {said.get(self.why, self.why)}"
        )


def read(out: Path, pairs: Iterable[str]) -> list[Stop]:
    """Where the rows of some pairs stopped; pairs without `until` have none."""
    found = []
    for pair in pairs:
        path = out / FOLDER / f"{pair}.json"
        if path.exists():
            try:
                content = bounded.read_json(path, finite=False)
                found.append(Stop(**content | {"by": tuple(content["by"])}))
            except (UserError, ValueError, TypeError, KeyError):
                raise UserError(f"{path} cannot be read; run the same command again to recreate it") from None
    return found


def write(out: Path, stop: Stop) -> None:
    """Write where a row stopped.

    Raises:
        UserError: if it cannot be written.
    """
    path = out / FOLDER / f"{stop.pair}.json"
    try:
        path.parent.mkdir(exist_ok=True)
        with files.whole(path) as file:
            file.write(json.dumps(asdict(stop), indent=1).encode() + b"\n")
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}") from error
