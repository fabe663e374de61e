"""The histogram of a certificate over frames: a mean hides the frames for which nothing is certain."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from rich.text import Text

BINS = 10
HEIGHTS = "▁▂▃▄▅▆▇█"
EMPTY = "·"


def certified_frames(records: pa.Table, column: str) -> Text | None:
    """A histogram of what is certified over all frames of some episodes, with its mean; None where nothing is recorded.

    Args:
        records: of episodes.
        column: the list of what is certified of each frame, in [0, 1] (`Track.certificates`); empty for none.
    """
    if not column or column not in records.column_names:
        return None
    values = records[column].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    if not len(values):
        return None
    counts = np.histogram(values, bins=BINS, range=(0.0, 1.0))[0]
    shares = counts / len(values)
    return Text.assemble(
        ("0 ", "dim"),
        "".join(_bar(share) for share in shares),
        (" 1", "dim"),
        f"  {len(values)} frames, mean {values.mean():.2f}, "
        f"below {1 / BINS:g} in {100 * shares[0]:.0f} %, above {1 - 1 / BINS:g} in {100 * shares[-1]:.0f} %",
    )


def _bar(share: float) -> str:
    """A bar of eight heights, which is never empty where there is a frame."""
    return HEIGHTS[min(int(share * len(HEIGHTS)), len(HEIGHTS) - 1)] if share > 0 else EMPTY
