"""Episodes side by side: on the training seeds, cells and scenarios that all of them have."""

from __future__ import annotations

from cavbench.statistics.episodes import Episodes, shared


def beside(own: Episodes, control: Episodes) -> tuple[Episodes, Episodes]:
    """Some episodes and their control on the scenarios that both have; a control of one run stands for every run.

    Raises:
        ValueError: if they have nothing in common.
    """
    if len(control.runs) == 1 and not set(own.runs) <= set(control.runs):
        control = control.standing_for(own.runs, [cell for cell in own.cells if cell in control.cells])
    return shared(own, control)


def without_seed(own: Episodes, control: Episodes) -> bool:
    """Whether a control of one run stands for every run of `own`: both are of the same weights, whatever the training seed."""
    if len(control.runs) > 1 or control.runs == own.runs:
        return False
    weights, others = (set(one.table["weights_sha256"].unique().to_pylist()) for one in (own, control))
    return weights <= others


def with_control(own: Episodes, control: Episodes | None) -> tuple[Episodes, Episodes | None]:
    """Some episodes and their clean control, both reduced to what they share; no control where that is nothing."""
    if control is None:
        return own, None
    try:
        if not without_seed(own, control):
            return shared(own, control)
        cells, seeds = set(own.cells) & set(control.cells), set(own.seeds) & set(control.seeds)
        return own.only(cells=cells, seeds=seeds), control.only(cells=cells, seeds=seeds)
    except ValueError:
        return own, None
