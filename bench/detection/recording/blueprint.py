"""The viewer layout of an approach: its frames side by side, the crafting of the patch, charts, and the "About" page."""

from __future__ import annotations

from collections.abc import Mapping

import rerun.blueprint as rrb

from cavbench.detection import Scenes
from cavbench.detection.approach import Sighting, measured
from cavbench.detection.sight import Sight
from cavbench.recording import about
from cavbench.recording.blueprint import bare

NAMES = {"with_patch": "With the patch", "without_patch": "Without a patch"}
FPS = 2.0
"""Playback speed in frames per second: half of real time."""
GAP = 8
"""Texels between two patches in the strip."""


def sights(sighting: Sighting) -> dict[str, Sight]:
    """The detector's output with and without the patch, by entity name; only without, if there is no attack."""
    if sighting.clean is None:
        return {"without_patch": sighting.shown}
    return {"with_patch": sighting.shown, "without_patch": sighting.clean}


def layout(sighting: Sighting) -> rrb.Blueprint:
    """The blueprint of an approach; empty views are left out."""
    frames = [_frame(sighting, name) for name in sights(sighting)]
    below: list[rrb.View] = [rrb.BarChartView(origin="confidence", name="Confidence over distance (m)")]
    rows: list[rrb.Container | rrb.View] = [rrb.Horizontal(*frames)]
    shares = [3.0]
    evolution = sighting.patch.evolution if sighting.patch else None
    if evolution:
        side = evolution.texels.shape[-1]
        first = next(iter(evolution.losses), "")
        name = f"Crafting of the patch (step{': ' + first if first else ''})"
        bounds = rrb.VisualBounds2D(
            x_range=(0, len(evolution.steps) * (side + GAP) - GAP), y_range=(-0.05 * side, 1.4 * side)
        )
        rows.append(rrb.Spatial2DView(origin="evolution", name=name, visual_bounds=bounds))
        shares.append(1.1)
        if evolution.losses:
            below.append(rrb.BarChartView(origin="losses", name="Losses over crafting steps"))
    if sighting.texels is not None:
        side = sighting.texels.shape[-1]
        bounds = rrb.VisualBounds2D(x_range=(0, side), y_range=(0, side))
        below.append(rrb.Spatial2DView(origin="patch", name="The patch", visual_bounds=bounds))
    below.append(rrb.TextDocumentView(origin="about", name="About"))
    rows.append(rrb.Horizontal(*below))
    shares.append(3.0)
    return bare(rrb.Vertical(*rows, row_shares=shares), timeline="frame", fps=FPS)


def _frame(sighting: Sighting, name: str) -> rrb.View:
    """The view of a frame, zoomed to the part that contains the sign in all frames."""
    boxes = sighting.approach.scenes.boxes
    low, high = boxes[:, :2].amin(0), boxes[:, 2:].amax(0)
    margin = (boxes[:, 2:] - boxes[:, :2]).max()
    (left, top), (right, bottom) = (low - margin / 2).tolist(), (high + margin / 2).tolist()
    return rrb.Spatial2DView(
        origin=name,
        name=f"{NAMES[name]}: {outcome(sights(sighting)[name], sighting.approach.scenes)}",
        visual_bounds=rrb.VisualBounds2D(x_range=(left, right), y_range=(top, bottom)),
    )


def outcome(sight: Sight, scenes: Scenes) -> str:
    """Where the sign is confirmed, and where the car stops, as text."""
    measurements = measured([sight], [scenes])
    confirmed, overrun = float(measurements["confirmed_m"][0]), float(measurements["overrun_m"][0])
    if not confirmed:
        return "the sign is never confirmed, the car drives on"
    stops = f"{overrun:.1f} m beyond the line" if overrun else "in time"
    return f"the sign is confirmed at {confirmed:.1f} m, the car stops {stops}"


def page(sighting: Sighting, meta: Mapping[str, object]) -> str:
    """The "About" page: the outcome of the approach and its components."""
    lines = [f"**{sighting.approach.location}**", ""]
    for name, sight in sights(sighting).items():
        measurements = measured([sight], [sighting.approach.scenes])
        lines += [
            f"**{NAMES[name]}**",
            f"- {outcome(sight, sighting.approach.scenes)}",
            f"- mean confidence: {float(measurements['confidence_mean'][0]):.2f}",
            f"- false alarms per frame: {float(measurements['false_alarms'][0]):.1f}",
            "",
        ]
    patch = sighting.patch
    if patch and patch.texels is not None:
        side = patch.texels.shape[-1]
        lines.append(
            f"patch: {side} x {side} texels, {sighting.share:g} of the sign's width, crafted in {patch.seconds:.0f} s "
            f"with {patch.queries} queries"
        )
    return about.page(meta, lines, queries="per patch" if sighting.clean else "")
