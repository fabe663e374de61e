"""The commands that the soak kills, and how their results are compared."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow.parquet as pq

from cavbench.core.track import tracks

RUN = (
    *(
        "run",
        "attack=nudge",
        "victim=toy",
        "world=toy",
        "lanes=3,4,5",
        "density=1,2",
        "weather=clear,fog",
        "seeds=0,1,2",
    ),
    *("attack.pause=0.05", "episodes=4", "record=0", "reference=false", "workers=2"),
)
CRAFT = (
    *("run", "attack=paint", "victim=red", "world=red_street", "weather=clear,fog", "seeds=0,1,2"),
    *("record=0", "workers=2"),
)
TRAIN = (
    *("train", "victim=dqn", "world.vehicles=3", "world.max_steps=30", "seeds=0"),
    *("victim.decisions=300", "victim.checkpoints=1", "victim.hidden=16", "victim.batch=32", "victim.copies=4"),
)
REPORT = ("report", "leaderboard")
MADE = re.compile(r'"made":"[^"]*"')
"""Matches the time in a page."""


@dataclass(frozen=True)
class Subject:
    """A command.

    Args:
        name: what the table calls it.
        command: its words, without the folder.
        place: the word that gives it a folder, for instance `out={out}`.
        pattern: the files that it keeps when it is killed, and never changes.
    """

    name: str
    command: Sequence[str]
    place: str
    pattern: str

    def words(self, out: Path) -> list[str]:
        """The command with its folder."""
        return [*self.command, self.place.format(out=out)]

    def finished(self, out: Path) -> Mapping[str, str]:
        """The hash of each file that is finished."""
        paths = out.glob(self.pattern)
        return {
            path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths if not path.name.startswith(".")
        }

    def result(self, out: Path) -> object:
        """What must be equal after any number of kills: all values but times."""
        if self.command[0] == "report":
            return {path.name: MADE.sub("", path.read_text()) for path in sorted(out.glob(self.pattern))}
        if self.command[0] != "run":
            return self.finished(out)
        return {path.name: _values(path) for path in sorted(out.glob("episodes/*.parquet"))}


def _values(path: Path) -> object:
    """The values of a record that do not depend on when it was driven."""
    beside = {"created_at", "wall_s", "crafting_s", *(field.name for track in tracks() for field in track.probes)}
    beside |= {name for track in tracks() for name in track.unrepeatable}
    records = pq.read_table(path)
    return records.select([name for name in records.column_names if name not in beside]).to_pydict().__repr__()


SUBJECTS: Mapping[str, Subject] = {
    subject.name: subject
    for subject in (
        Subject("run", RUN, "out={out}", "episodes/*.parquet"),
        Subject("craft", CRAFT, "out={out}", "*/*.*"),
        Subject("train", TRAIN, "out={out}", "**/*.safetensors"),
        Subject("report", REPORT, "html={out}/page.html", "page.*"),
        Subject("ray", (*RUN, "executor=ray"), "out={out}", "episodes/*.parquet"),
    )
}
Condition = Callable[[Path, Path], str]
