"""Scores as a table for LaTeX and as plots say what the DataFrame says."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

import cavbench
from cavbench.envs.highway.world import HighwayWorld

mpl.use("Agg")
WHERE: dict[str, Any] = {
    "lanes": [3, 4],
    "density": 1,
    "weather": "clear",
    "episodes": 2,
    "seeds": [0],
    "baselines": False,
}


@pytest.fixture(scope="module")
def scored(tmp_path_factory: pytest.TempPathFactory) -> Any:
    out = tmp_path_factory.mktemp("results")

    def call(**options: Any) -> Any:
        return cavbench.score(
            "dqn", ["noise", "bias"], world=HighwayWorld(max_steps=10), out=out, **{**WHERE, **options}
        )

    return call


def test_latex_has_a_line_a_row_with_intervals_and_nothing_that_latex_takes_for_its_own(scored: Any) -> None:
    scores = scored()
    text = scores.to_latex()
    assert text.count(r" \\") == 1 + len(scores)
    assert r"\toprule" in text
    row = scores.iloc[0]
    assert f"{row.safe_progress:.2f} {{\\scriptsize [{row.low:.2f}, {row.high:.2f}]}}" in text
    assert "_" not in text.replace(r"\_", "")
    assert "lanes" not in text.lower()
    assert "Lanes" in scored(by="cell").to_latex()


def test_the_matrix_has_the_score_of_each_attack_and_of_none(scored: Any) -> None:
    scores = scored()
    axes = scores.plot()
    (image,) = axes.images
    names = [label.get_text() for label in axes.get_xticklabels()]
    assert names[:2] == ["no attack", "strongest of 2"]
    clean = scores[scores.role == "clean"].safe_progress.iloc[0]
    assert image.get_array()[0, 0] == pytest.approx(clean)
    with pytest.raises(cavbench.UserError, match="by pair"):
        scored(by="cell").plot("matrix")


def test_the_cells_are_a_heat_map_of_the_strongest_attack(scored: Any) -> None:
    scores = scored(by="cell")
    axes = scores.plot("cells")
    strongest = scores[scores.role == "strongest"]
    np.testing.assert_allclose(np.ravel(axes.images[0].get_array()), strongest.safe_progress)
    assert [label.get_text() for label in axes.get_yticklabels()] == ["3 × 1", "4 × 1"]
    with pytest.raises(cavbench.UserError, match="by='cell'"):
        scored().plot("cells")


def test_scores_against_the_budget_begin_with_no_attack(scored: Any) -> None:
    small, large = scored(), scored(threat={"budget": 0.2})
    axes = small.plot("budget", large)
    for line in (one.lines[0] for one in axes.containers):
        np.testing.assert_allclose(line.get_xdata(), [0, 0.1, 0.2])
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert sorted(labels) == ["bias on dqn", "noise on dqn"]
    with pytest.raises(cavbench.UserError, match="only 'budget' takes others"):
        small.plot("matrix", large)


def test_an_unknown_plot_and_a_missing_matplotlib_are_one_line(scored: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(cavbench.UserError, match="unknown plot 'cell'; did you mean 'cells'"):
        scored().plot("cell")
    monkeypatch.setitem(importlib.import_module("sys").modules, "matplotlib", None)
    with pytest.raises(cavbench.UserError, match=r"pip install 'cavbench\[plot\]'"):
        scored().plot()


def test_a_plot_is_saved(scored: Any, tmp_path: Path) -> None:
    scored().plot().figure.savefig(tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 5000
