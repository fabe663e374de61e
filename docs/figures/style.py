"""Style of all figures: light background, colours safe for colour-blind readers, text legible at a width of 360 pixels."""

from __future__ import annotations

import io
import re
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

# Okabe and Ito's colours.
BLUE, ORANGE, GREEN, RED, PURPLE, SKY, YELLOW = (
    "#0072b2",
    "#e69f00",
    "#009e73",
    "#d55e00",
    "#cc79a7",
    "#56b4e9",
    "#f0e442",
)
INK, GREY, FAINT, GROUND = "#222222", "#767676", "#d9d9d4", "#fcfcfa"

TRUE, SHOWN = BLUE, RED
"""Colours of the measured and of the attacked observation."""
UNDEFENDED, HARDENED = RED, GREEN
FAULT = PURPLE
"""Colour of what happens without an adversary."""
ACTIONS = {"LANE_LEFT": PURPLE, "IDLE": GREY, "LANE_RIGHT": ORANGE, "FASTER": RED, "SLOWER": BLUE}
"""Colours by name of the action, in the order of `cavbench.envs.highway.config.ACTIONS`."""

WIDTH = 6.0
"""Width of a figure in inches."""
PNG_DPI, PNG_COLOURS, WEBP_QUALITY = 110, 96, 80

STYLE = {
    "svg.hashsalt": "cavbench",
    "svg.fonttype": "path",
    "font.family": "DejaVu Sans",
    "font.size": 11,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.labelsize": 11,
    "xtick.labelsize": 10,
    "ytick.labelsize": 10,
    "legend.fontsize": 10,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "text.color": INK,
    "axes.labelcolor": INK,
    "figure.facecolor": GROUND,
    "axes.facecolor": GROUND,
    "savefig.facecolor": GROUND,
}

LONG_NUMBER = re.compile(r"(?<=[\s\"])-?\d+\.\d{2,}(?=[\s\"])")
"""A coordinate in an SVG file. One decimal is enough: a tenth of a point."""

UNUSED = re.compile(r'(?s)<metadata>.*?</metadata>\n|(?<=<g) id="[a-z0-9_.]+"(?=>)')
"""What says who made an SVG file, and names of groups to which nothing refers."""

SAME_COMMAND = re.compile(r"(?:[LM] [-\d. ]+(?:\nL [-\d. ]+)+|Q [-\d. ]+(?:\nQ [-\d. ]+)+)")
"""Lines of a path in an SVG file, one after the other, or curves: the letter is needed once."""


def figure(height: float, title: str) -> Figure:
    """An empty figure of `height` inches with a title."""
    made = Figure(figsize=(WIDTH, height), layout="constrained")
    made.suptitle(title, x=0.01, ha="left", fontsize=12.5, fontweight="bold")
    return made


def bare(axes: Axes) -> None:
    """Remove ticks and frame."""
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def save(made: Figure, path: Path) -> None:
    """Write a figure as SVG, PNG or, for photographs, WebP: the same bytes every time."""
    if path.suffix == ".svg":
        drawn = io.StringIO()
        made.savefig(drawn, format="svg", metadata={"Date": None, "Creator": None})
        text = LONG_NUMBER.sub(lambda number: f"{float(number[0]):.1f}", drawn.getvalue())
        text = UNUSED.sub("", re.sub(r"\s*\n\s*", "\n", text))
        path.write_text(SAME_COMMAND.sub(_joined, text))
        return
    drawn = io.BytesIO()
    made.savefig(drawn, format="png", dpi=PNG_DPI)
    image = Image.open(drawn).convert("RGB")
    if path.suffix == ".webp":
        image.save(path, quality=WEBP_QUALITY, method=6)
    else:
        image.quantize(PNG_COLOURS).save(path, optimize=True)


def _joined(commands: re.Match[str]) -> str:
    first, *others = commands[0].split("\n")
    return " ".join([first, *(command[2:] for command in others)])


mpl.rcParams.update(STYLE)
