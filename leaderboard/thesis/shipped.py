"""The records that the thesis' tables are made of, shipped with the package.

    python -m cavbench.leaderboard.thesis.shipped RESULTS policies    # those of chapter 4 become the newest of a folder

They are data of this report alone: single attacks on parts of the grid, in the thesis' threat models, which no leaderboard
ranks. Each record says its cell; together they are no grid that can be chosen.
"""

from __future__ import annotations

import argparse
from importlib.resources import as_file, files
from pathlib import Path
from typing import Literal

import pyarrow as pa

from cavbench.core.track import track
from cavbench.detection.track import DetectionTrack
from cavbench.driving.track import DrivingTrack
from cavbench.leaderboard.published import write_records
from cavbench.records.reading import read, read_file

TRACKS = {"patches": DetectionTrack.name, "policies": DrivingTrack.name}
"""The track of each chapter's records."""


def shipped(chapter: Literal["patches", "policies"]) -> pa.Table:
    """The records of chapter 3 (`patches`) or 4 (`policies`)."""
    with as_file(files("cavbench.leaderboard") / "thesis" / f"{chapter}.parquet") as path:
        return read_file(path)


def publish(folder: Path, chapter: str, file: Path) -> int:
    """Write the newest records of a results folder as those of a chapter, and return how many they are.

    Raises:
        UserError: if the folder has none of that track.
    """
    records = read(folder, track=track(TRACKS[chapter]))
    write_records(records, file)
    return int(records.num_rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description="Publish the newest records of a results folder for the thesis' tables."
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("chapter", choices=TRACKS)
    words = parser.parse_args()
    with as_file(files("cavbench.leaderboard") / "thesis" / f"{words.chapter}.parquet") as target:
        publish(words.folder, words.chapter, target)
