"""The leaderboards over worlds: of some records, or of the published ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pyarrow as pa

from cavbench.leaderboard.published import every_track, of_worlds
from cavbench.leaderboard.ranking.boards import Board, read_boards
from cavbench.leaderboard.ranking.worlds import WorldBoard, over_several


def read_worlds(records: Mapping[str, pa.Table]) -> list[WorldBoard]:
    """The leaderboards over worlds of these records, by track; of the published ones where there are none."""
    return over_several(read_boards(records)[0]) if records else published_worlds(read_boards(every_track())[0])


def published_worlds(boards: Sequence[Board]) -> list[WorldBoard]:
    """Those of the published records: of the records that are for this alone, then of the leaderboards of single worlds."""
    own = of_worlds()
    return [*(over_several(read_boards(own)[0]) if own else []), *over_several(boards)]
