"""The leaderboard: the published records under the first threat model of each track."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.transforms import blended_transform_factory

from cavbench.core.track import tracks
from cavbench.leaderboard.published import published
from cavbench.leaderboard.ranking.boards import Board, Row, read_boards
from cavbench.statistics.estimates import Interval, share_interval
from docs.figures import style

MEASURES = {"driving": "safe progress", "detection": "stop score"}
MARKS = {
    "no attack": ("o", 7, style.TRUE),
    "strongest": ("o", 7, style.SHOWN),
    "best blind policy": ("|", 13, style.INK),
}
FLAGGED = 0.4
"""Opacity of a flagged row among others."""


def standard() -> Figure:
    """One row a defended victim: without an attack, and under the strongest attack in each cell."""
    boards, _ = read_boards({track.name: published(track) for track in tracks()})
    first: dict[str, Board] = {}
    for board in boards:
        first.setdefault(board.track.name, board)
    rows = [len(board.rows) for board in first.values()]
    made = style.figure(1.9 + 0.34 * sum(rows), "What the strongest attack leaves")
    for axes, board in zip(made.subplots(len(first), 1, height_ratios=rows), first.values(), strict=True):
        _draw(axes, board)
    handles = [Line2D([], [], marker=mark, ls="", ms=size, color=colour) for mark, size, colour in MARKS.values()]
    made.legend(handles, MARKS, loc="outside lower center", ncols=3, handletextpad=0.1)
    return made


def _draw(axes: Axes, board: Board) -> None:
    names = blended_transform_factory(axes.transAxes, axes.transData)
    all_flagged = all(row.flagged for row in board.rows)
    for place, row in enumerate(board.rows):
        opacity = FLAGGED if row.flagged and not all_flagged else 1
        worst = row.worst.score
        if row.worst.clean:
            axes.plot([worst.estimate, row.worst.clean.estimate], [place, place], color=style.FAINT, lw=5, zorder=1)
            point(axes, row.worst.clean, place, style.TRUE, opacity)
        point(axes, worst, place, style.SHOWN, opacity)
        if np.isfinite(row.worst.rival).all():
            blind = share_interval(row.worst.rival[None]).estimate
            axes.plot(blind, place, "|", color=style.INK, ms=13, mew=1.8)
        axes.text(
            -0.02,
            place,
            _name(row, said=all_flagged),
            transform=names,
            ha="right",
            va="center",
            alpha=max(opacity, 0.65),
        )
    axes.set(xlim=(0, 1), ylim=(len(board.rows) - 0.5, -0.5), yticks=[], xlabel=MEASURES[board.track.name])
    axes.spines["left"].set_visible(False)
    norm, budget, *_ = board.threat
    flagged = ", all rows flagged" if all_flagged else ""
    axes.set_title(f"{board.track.name}, {norm} {budget:g}{flagged}", fontsize=10.5)


def point(axes: Axes, found: Interval, place: int, colour: str, opacity: float = 1) -> None:
    """An estimate with its interval, on the line `place`."""
    axes.plot([found.low, found.high], [place, place], color=colour, lw=2.2, alpha=opacity, clip_on=False)
    axes.plot(found.estimate, place, "o", color=colour, ms=7, alpha=opacity, mec="none", clip_on=False)


def plain_name(row: Row) -> str:
    """Victim and defence."""
    victim, defense = (str(row.identity[name]) for name in ("victim", "defense"))
    return victim if defense == "none" else f"{victim} + {defense.removesuffix('_detection')}"


def _name(row: Row, *, said: bool) -> str:
    """Victim and defence; and that the row is flagged, if that is not said of all."""
    return f"{plain_name(row)} (flagged)" if row.flagged and not said else plain_name(row)
