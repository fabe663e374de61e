"""The histogram of a certificate over frames."""

from __future__ import annotations

import pyarrow as pa

from cavbench.core.track import track
from cavbench.leaderboard.terminal.certified_frames import certified_frames
from tests.leaderboard.synthetic import approach

COLUMN = track("detection").certificates


def table(*frames: list[float] | None) -> pa.Table:
    return pa.table({COLUMN: pa.array(frames, pa.list_(pa.float64()))})


def said(*frames: list[float] | None) -> str:
    found = certified_frames(table(*frames), COLUMN)
    assert found is not None
    return found.plain


def test_it_shows_all_frames_of_all_episodes_and_the_ends() -> None:
    assert said([0.0, 1.0, 1.0, 0.95], None, [0.5, 0.99, 0.92, 1.0]) == (
        "0 ▂····▂···▇ 1  8 frames, mean 0.80, below 0.1 in 12 %, above 0.9 in 75 %"
    )
    assert said([1.0]) == "0 ·········█ 1  1 frames, mean 1.00, below 0.1 in 0 %, above 0.9 in 100 %"
    # One frame of a thousand is seen.
    assert said([1.0] * 999 + [0.31])[5] == "▁"


def test_records_without_a_certificate_have_no_histogram() -> None:
    assert certified_frames(table(None, None), COLUMN) is None
    assert certified_frames(approach(0.9, attack="eot"), COLUMN) is None
    assert certified_frames(table([0.5]), "") is None
    assert certified_frames(pa.table({"score": [0.5]}), COLUMN) is None
