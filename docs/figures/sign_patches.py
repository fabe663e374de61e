"""Patches on the sign: their look, and the confidence of YOLOv3-tiny over the distance."""

from __future__ import annotations

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from torch import Tensor

from docs.figures import style
from docs.figures.patches import patch_of, texels_of
from docs.figures.sightings import (
    FRAME,
    approaches,
    clean,
    crop,
    curve,
    detector,
    frame_axes,
    patched,
    picture,
    said,
    show,
    undisturbed,
)

MOMENTS = 5
"""Number of crafting steps to show."""


def eot() -> Figure:
    """A patch by gradients."""
    return _crafted("eot")


def square_patch() -> Figure:
    """A patch by random search."""
    return _crafted("square_patch")


def transfer() -> Figure:
    """A patch against another detector."""
    made = style.figure(2.5, "transfer: a patch against yolov5, shown to yolov3_tiny")
    _signs(made.subfigures(1, 1), texels_of("transfer", surrogates="yolov5"))
    return made


def _crafted(attack: str) -> Figure:
    """The patch at several crafting steps, the sign with it, and the confidence."""
    made, (crafted, below) = _begun(attack, 6.4, (1.15, 3.6))
    evolution = patch_of(attack).evolution
    assert evolution is not None
    chosen = torch.linspace(0, len(evolution.steps) - 1, MOMENTS).round().long()
    crafted.suptitle(
        "as it comes about: step of the crafting, and score of a stop sign", x=0.01, ha="left", fontsize=10
    )
    for axes, place in zip(crafted.subplots(1, MOMENTS), chosen, strict=True):
        show(axes, evolution.texels[place] / 255)
        axes.set_title(f"step {int(evolution.steps[place])}: {float(evolution.losses['found'][place]):.2f}", fontsize=9)
    _seen(below, attack)
    return made


def noise_patch() -> Figure:
    """The sign with random texels."""
    made, (below,) = _begun("noise_patch", 5.0, (1,))
    _seen(below, "noise_patch")
    return made


def grey_patch() -> Figure:
    """The sign with a grey square."""
    made, (below,) = _begun("grey_patch", 5.0, (1,))
    _seen(below, "grey_patch")
    return made


def _begun(attack: str, height: float, ratios: tuple[float, ...]) -> tuple[Figure, list[SubFigure]]:
    """A figure whose title gives the stop score without and with the patch, and its subfigures."""
    pair = patched(attack)
    before, after = undisturbed(pair), pair.score.estimate
    made = style.figure(height, f"{attack}: stop score {before:.2f} without, {after:.2f} with it")
    return made, list(made.subfigures(len(ratios), 1, height_ratios=ratios, squeeze=False)[:, 0])


def _seen(part: SubFigure, attack: str) -> None:
    """The patch, the sign without and with it, and the confidence."""
    pictures, curves = part.subfigures(2, 1, height_ratios=(1, 1.25))
    _signs(pictures, texels_of(attack))
    _curves(curves.subplots(), attack)


def _signs(part: SubFigure, texels: Tensor) -> None:
    """The patch, and the sign without and with it."""
    approach = approaches()[0]
    patch, *signs = part.subplots(1, 3)
    patch.imshow(texels.permute(1, 2, 0).numpy(), interpolation="nearest")
    style.bare(patch)
    patch.set_title("the patch", fontsize=10)
    for axes, worn, name in zip(signs, (None, texels), ("without", "with it"), strict=True):
        shown = picture(approach, FRAME, worn)
        show(axes, crop(shown, approach, FRAME))
        axes.set_title(f"{name}: {said(detector(), shown, approach, FRAME):.2f}", fontsize=10)


def _curves(axes: Axes, attack: str) -> None:
    """Draw the confidence from the published records."""
    pair = patched(attack)
    curve(axes, clean(pair), style.BLUE, "no patch")
    if attack != "eot":
        curve(axes, patched("eot").own.table, style.GREY, "eot", "--")
    curve(axes, pair.own.table, style.RED, attack)
    frame_axes(axes)
    axes.set_title("clear weather: median of the approaches, band: 8 of 10", fontsize=10)
    axes.legend(loc="center right", ncols=3)
