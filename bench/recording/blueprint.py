"""The layout of a recording in rerun's viewer."""

from __future__ import annotations

import rerun.blueprint as rrb


def bare(views: rrb.Container, *, timeline: str, fps: float) -> rrb.Blueprint:
    """A blueprint with these views and a timeline, without rerun's panels."""
    return rrb.Blueprint(
        views,
        rrb.BlueprintPanel(state=rrb.PanelState.Hidden),
        rrb.SelectionPanel(state=rrb.PanelState.Hidden),
        rrb.TimePanel(state=rrb.PanelState.Collapsed, timeline=timeline, fps=fps),
        auto_views=False,
        auto_layout=False,
    )
