"""Detectors on approaches: frames, crops of the sign, and confidence over the distance."""

from __future__ import annotations

from functools import cache

import numpy as np
import pyarrow as pa
import torch
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from torch import Tensor

from cavbench.core.pair import choose
from cavbench.core.track import track
from cavbench.detection import STOP_SIGN, Approach, Detector
from cavbench.detection.boxes import confidence
from cavbench.detection.sight import Sight, look
from cavbench.detection.stopping import THRESHOLD
from cavbench.envs.camera.axes import APPROACH_V1, AXES
from cavbench.envs.camera.world import StopSignApproach
from cavbench.leaderboard.comparisons.comparison import Comparison, parameters
from cavbench.leaderboard.comparisons.pairing import beside
from cavbench.leaderboard.comparisons.reading import read_comparisons
from cavbench.leaderboard.published import published
from docs.figures import style
from docs.figures.patches import SHARE

LANES, DENSITY = 3, 1.0
FRAME = 6
"""Index of the shown frame of an approach: some 15 m before the sign."""
MARGIN = 1.1
"""Margin around the sign in a crop, in half widths of the sign."""


@cache
def approaches(weather: str = "clear") -> list[Approach]:
    """One approach at each place."""
    return choose("world", "camera").component.approaches(
        AXES.cell(lanes=LANES, density=DENSITY, weather=weather), APPROACH_V1.seeds()
    )


@cache
def detector(victim: str = "yolov3_tiny", defense: str = "none") -> Detector:
    """The (defended) detector."""
    return choose("defense", defense).component.load(choose("victim", victim).component, 0, StopSignApproach().facts)


def sight(of: Detector, approach: Approach, texels: Tensor | None = None) -> Sight:
    """The detections on an approach, with or without a patch on the sign."""
    with torch.no_grad():
        return look(of, approach.scenes, texels, SHARE)


def picture(approach: Approach, frame: int, texels: Tensor | None = None) -> Tensor:
    """One frame [3, H, W], with or without a patch on the sign."""
    patches = None if texels is None else texels[None]
    with torch.no_grad():
        return approach.scenes.render(torch.tensor([frame]), patches, SHARE)[0]


def show(axes: Axes, shown: Tensor) -> None:
    """Show an image [3, H, W] without axes."""
    axes.imshow(shown.clamp(0, 1).permute(1, 2, 0).numpy(), interpolation="lanczos")
    style.bare(axes)


def crop(shown: Tensor, approach: Approach, frame: int) -> Tensor:
    """The part of an image around the sign."""
    left, top, right, bottom = approach.scenes.boxes[frame].tolist()
    around = MARGIN * (right - left) / 2
    x, y = (round(max(0, low - around)) for low in (left, top))
    return shown[:, y : round(bottom + around), x : round(right + around)]


def said(of: Detector, shown: Tensor, approach: Approach, frame: int) -> float:
    """Confidence in the sign in one image."""
    with torch.no_grad():
        predictions = of(shown[None])
    return float(confidence(predictions, of.index(STOP_SIGN), approach.scenes.boxes[frame : frame + 1]))


def box(axes: Axes, corners: Tensor, text: str, colour: str, *, below: bool = False) -> None:
    """Draw a box with a label above or below it."""
    left, top, right, bottom = corners.tolist()
    axes.add_patch(Rectangle((left, top), right - left, bottom - top, fill=False, edgecolor=colour, lw=1.8))
    ground = {"facecolor": style.GROUND, "edgecolor": "none", "alpha": 0.7, "pad": 1}
    place, away = ((left, bottom), (0, -10)) if below else ((left, top), (0, 2))
    axes.annotate(text, place, away, textcoords="offset points", fontsize=9.5, bbox=ground)


@cache
def patched(attack: str, defense: str = "none") -> Comparison:
    """The published approaches of `yolov3_tiny` under the default attack in clear weather, with their controls.

    The roads are those that every row has: three and four lanes, light traffic.
    """
    wanted: dict[str, object] = {
        "attack": attack,
        "defense": defense,
        "victim": "yolov3_tiny",
        "threat_budget": SHARE,
        "grid": APPROACH_V1.name,
    }
    # Older records lack parameters that came later.
    defaults = parameters(choose("attack", attack).params).items()
    (found,) = (
        pair
        for pair in _comparisons()
        if wanted.items() <= pair.identity.items() and parameters(pair.identity["attack_params"]).items() <= defaults
    )
    return found.only(cells=[c for c in found.cells if c.weather == "clear" and c.density == DENSITY and c.lanes < 5])


@cache
def _comparisons() -> list[Comparison]:
    own = track("detection")
    return read_comparisons(published(own), own)


def clean(pair: Comparison) -> pa.Table:
    """The records of a pair's approaches without a patch, repeated for each patch seed."""
    assert pair.clean
    return beside(pair.own, pair.clean)[1].table


def undisturbed(pair: Comparison) -> float:
    """Stop score without a patch."""
    assert pair.clean_score
    return pair.clean_score.estimate


def curve(axes: Axes, records: pa.Table, colour: str, label: str, dashes: str = "-") -> None:
    """Draw the median confidence over the distance, with a band that holds eight of ten approaches."""
    distance, seen = (_frames(records, name) for name in ("frame_distance_m", "frame_confidence"))
    low, middle, high = np.quantile(seen, (0.1, 0.5, 0.9), axis=0)
    axes.fill_between(distance[0], low, high, color=colour, alpha=0.18, lw=0)
    axes.plot(distance[0], middle, color=colour, ls=dashes, lw=2.2, marker="o", ms=4, label=label)


def frame_axes(axes: Axes) -> None:
    """Label axes for confidence over distance."""
    axes.axhline(THRESHOLD, color=style.GREY, lw=1, ls=":")
    axes.set(xlabel="m before the sign", ylabel="confidence", ylim=(-0.03, 1.03))
    axes.invert_xaxis()
    axes.annotate(
        "detected above", (0.995, THRESHOLD), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=9
    )


def _frames(records: pa.Table, name: str) -> NDArray[np.float64]:
    """[approaches, frames] of a column of lists."""
    return np.array(records[name].to_pylist(), dtype=np.float64)
