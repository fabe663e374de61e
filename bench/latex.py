"""Tables for LaTeX, for the package booktabs."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cavbench.errors import plain

SPECIAL = {
    **{letter: f"\\{letter}" for letter in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "×": r"$\times$",
    "−": "$-$",
}
"""What LaTeX writes for a letter that means something to it."""


def escaped(text: str) -> str:
    """A text as LaTeX prints it, without control characters."""
    return "".join(SPECIAL.get(letter, letter) for letter in plain(text))


def estimate(value: float, low: float | None, high: float | None, digits: int = 2) -> str:
    """A number, and its interval small behind it where there is one."""
    known = low is not None and high is not None and not (math.isnan(low) or math.isnan(high))
    return f"{value:.{digits}f}" + (rf" {{\scriptsize [{low:.{digits}f}, {high:.{digits}f}]}}" if known else "")


def booktabs(title: str, kinds: str, heads: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table under a comment with its title.

    Args:
        title: one line.
        kinds: a letter a column: l for text, r for numbers.
        heads: of the columns, escaped.
        lines: cells, escaped.
    """
    return "\n".join(
        (
            f"% {plain(title)}",
            f"\\begin{{tabular}}{{{kinds}}}",
            r"\toprule",
            _line(heads),
            r"\midrule",
            *map(_line, lines),
            r"\bottomrule",
            r"\end{tabular}",
            "",
        )
    )


def _line(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"
