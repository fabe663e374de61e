"""What drivers keep on the road that they were trained on: the table of docs/leaderboard_worlds.md, from the published records.

    python studies/at_home.py

The ends of each scale and the score under attack are those of `bench report worlds`.
"""

from __future__ import annotations

import duckdb
from rich.console import Console

from cavbench.leaderboard.published import of_worlds
from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.leaderboard.ranking.methods import EACH
from cavbench.leaderboard.ranking.worlds import over_several

CLEAN = """
    select world, avg(safe_progress) filter (not contains(victim_params, '"decisions":12000')) of_highway,
           avg(safe_progress) filter (contains(victim_params, '"decisions":12000')) trained_there
    from records where victim = 'dqn' and defense = 'none' and attack = 'none' group by world
"""


def main() -> None:
    """Print the table."""
    records = of_worlds()["driving"]
    (board,) = over_several(read_boards({"driving": records})[0])
    (row,) = (row for row in board.rows if row.method.home == EACH)
    clean = {world: scores for world, *scores in duckdb.sql(CLEAN).fetchall()}
    console = Console(width=130)
    console.print(
        "| world | best blind | `dqn` of highway, clean | trained there, clean | trained there, attacked | perfect |"
    )
    console.print("|---|---|---|---|---|---|")
    for world, place in row.places.items():
        scores = (place.blind, *clean[world], float(place.worst.scores.mean()), place.perfect)
        console.print(f"| `{world}` | {' | '.join(f'{score:.2f}' for score in scores)} |")


if __name__ == "__main__":
    main()
