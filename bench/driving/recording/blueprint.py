"""The viewer layout of an episode: road from above, decisions, curves, and the "About" page."""

from __future__ import annotations

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray

from cavbench.driving.recording import scene
from cavbench.driving.recording.curves import group
from cavbench.driving.recording.episode import Episode
from cavbench.recording import about
from cavbench.recording.blueprint import bare


def layout(episode: Episode) -> rrb.Blueprint:
    """The blueprint of an episode; empty views are left out."""
    rows: list[rrb.Container | rrb.View] = []
    shares: list[float] = []
    if episode.on_road:
        rows.append(_road(episode))
        shares.append(2.6)
    if episode.discrete:
        rows.append(rrb.StateTimelineView(origin="decision", name=_decision(episode)))
        shares.append(1.4 if episode.attacked else 1.0)
    rows.append(_curves(episode))
    shares.append(5.0)
    return bare(rrb.Vertical(*rows, row_shares=shares), timeline="time", fps=episode.facts.decision_hz)


def _road(episode: Episode) -> rrb.View:
    x, y = scene.bounds(episode)
    name = "Road from above: ego green, measured traffic blue"
    return rrb.Spatial2DView(
        origin="/",
        contents=["/road/**", "/traffic/**", "/ego/**"],
        name=f"{name}, attacked observation orange" if episode.attacked else name,
        background=(24, 25, 29),
        visual_bounds=rrb.VisualBounds2D(x_range=x, y_range=y),
    )


def _decision(episode: Episode) -> str:
    return "Decision: clean (measured observation), taken (attacked observation)" if episode.attacked else "Decision"


def _curves(episode: Episode) -> rrb.Container:
    """Three columns of curves, and the "About" page."""
    page_view = rrb.TextDocumentView(origin="about", name="About")
    shown = _scores(episode, "scores/shown", " on the attacked observation" if episode.attacked else "")
    drive = rrb.Tabs(
        _plot("worth", "Reward", 0.0, 1.0),
        _plot("speed", "Speed", 0.0, _top(episode.steps["speed"])),
        _plot("ttc", "TTC", 0.0, 20.0),
    )
    if not episode.attacked:
        return rrb.Horizontal(drive, shown, page_view)
    moved = []
    for path in dict.fromkeys(group(unit) for unit in episode.features.units):
        features = [
            name
            for name, unit in zip(episode.features.names, episode.features.units, strict=True)
            if group(unit) == path
        ]
        top = max(_top(values) for name in features for values in (episode.budget[name], episode.moved(name)))
        moved.append(_plot(path, f"Perturbation of {path.rpartition('/')[2]} and its budget", 0.0, top))
    queries = _plot("queries", "Queries", 0.0, _top(episode.steps["queries"]))
    measured = _scores(episode, "scores/measured", " on the measured observation", legend=False)
    curves = rrb.Grid(*moved, shown, drive, queries, measured, grid_columns=3)
    return rrb.Horizontal(curves, page_view, column_shares=[4, 1])


def _scores(episode: Episode, path: str, of: str, *, legend: bool = True) -> rrb.View:
    """The view of Q-values or continuous actions; both views of an episode share one axis range and one legend."""
    if not episode.discrete:
        return _plot(path, f"Action{of}", -1.0, 1.0, legend=legend)
    values = np.concatenate([episode.steps["scores"], episode.steps["clean_scores"]])
    return _plot(path, f"Q-values{of}", float(values.min()), float(values.max()), legend=legend)


def _top(values: NDArray[np.generic]) -> float:
    """The largest finite value, or 1 if none is above 0."""
    finite = np.asarray(values, dtype=np.float64)
    return max(float(finite[np.isfinite(finite)].max(initial=0.0)), 0.0) or 1.0


def _plot(path: str, name: str, low: float, high: float, *, legend: bool = True) -> rrb.TimeSeriesView:
    """A view of curves with room for the legend above them."""
    span = max(high - low, 1e-6)
    return rrb.TimeSeriesView(
        origin=path,
        name=name,
        axis_y=rrb.ScalarAxis(range=(low - 0.05 * span, high + 0.6 * span)),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
    )


def page(episode: Episode) -> str:
    """The "About" page: the outcome of the episode and its components."""
    steps = episode.steps
    lines = [f"**{episode.end}** after {len(episode)} steps ({episode.seconds:.1f} s)"]
    clean, taken = episode.choices
    if episode.discrete and episode.attacked:
        lines.append(f"- decisions changed: {100 * float((clean != taken).mean()):.0f} %")
    lines.append(f"- mean speed: {float(steps['speed'].mean()):.1f} m/s")
    lines.append(f"- return: {float(steps['reward'].sum()):.1f}")
    if episode.attacked:
        lines.append(f"- queries per step: {float(steps['queries'].mean()):.0f}")
    return about.page(episode.meta, lines, queries="per step" if episode.attacked else "")
