"""A track that a plug-in brings, in a world with axes of its own, is reported without an edit."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cavbench.core import registry
from cavbench.core.contracts import Facts
from cavbench.core.track import track
from cavbench.documents import schema as document_schema
from cavbench.records.schema import schema
from cavbench.records.store import FOLDER
from cavbench.scenarios import Axes, Axis, Cell, Grid
from cavbench.statistics.episodes import as_text
from tests.leaderboard.synthetic import baseline_drivers, drive, table
from tests.plugins.distributions import install

AXES = Axes(
    (
        Axis(name="curvature", kind="float", meaning="of the road", unit="1/m", low=0.0),
        Axis(name="gap", kind="int", meaning="to the car ahead", unit="m", low=5),
    )
)
GRID = Grid(name="bends", world="pole", axes=AXES, values={"curvature": (0.1, 0.2), "gap": (10, 20)}, episodes=4)


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The track as an installed distribution."""
    folder = tmp_path / "site"
    folder.mkdir()
    code = Path(__file__).with_name("toy_track.py").read_text()
    points = {"cavbench.tracks": {"balancing": "toy_track_plugin:BalancingTrack"}}
    install(folder, "cavbench-balancing", points, {"toy_track_plugin": code})
    monkeypatch.syspath_prepend(str(folder))
    _forget()
    yield folder
    _forget()
    sys.modules.pop("toy_track_plugin", None)


def _forget() -> None:
    registry.installed.cache_clear()
    track.cache_clear()


def records(attack: str, budget: float, left: float) -> pa.Table:
    """Two training seeds on every cell; the score falls with curvature."""
    cells = GRID.cells()
    run, place, seed = (axis.ravel() for axis in np.meshgrid(range(2), range(len(cells)), range(4), indexing="ij"))
    upright = left - np.array([cells[i].curvature for i in place]) + 0.01 * seed
    units = [hashlib.sha256(repr((attack, budget, *key)).encode()).hexdigest() for key in zip(run, place, strict=True)]
    columns: dict[str, object] = {
        "unit": units,
        "pair": f"{attack}-none-pid-{budget:g}",
        "attack": attack,
        "attack_params": '{"steps":3}' if budget else "{}",
        "defense": "none",
        "defense_params": "{}",
        "victim": "pid",
        "victim_params": "{}",
        "world": "pole",
        "world_params": "{}",
        "sees": True,
        "training_seed": run,
        "threat_norm": "push",
        "threat_budget": budget,
        "threat_access": "scores" if budget else "oblivious",
        "threat_queries": 10 if budget else 0,
        "threat_share": 1.0,
        "grid": "bends",
        "cell": [as_text(cells[i]) for i in place],
        "world_facts": json.dumps(
            Facts(axes=AXES, decision_hz=5, max_steps=100, actions=("left", "none", "right")).written()
        ),
        "seed": 1_000_000 + seed,
        "upright": upright,
        "swing_deg": 10.0,
        "created_at": datetime(2026, 1, 1, tzinfo=UTC),
        "wall_s": 1.0,
    }
    return table(schema(track("balancing")), columns, len(run))


@pytest.fixture
def results(plugin: Path, tmp_path: Path) -> Path:
    """A results folder of the third track."""
    out = tmp_path / "results"
    (out / FOLDER).mkdir(parents=True)
    both = pa.concat_tables([records("none", 0.0, 0.9), records("shove", 0.1, 0.5), records("shove", 0.2, 0.4)])
    pq.write_table(both, out / FOLDER / "balancing.parquet")
    return out


def bench(plugin: Path, *words: str) -> str:
    """The command line as a process of its own, with the plug-in installed."""
    script = "import sys; sys.path.insert(0, sys.argv.pop(1)); from cavbench.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", script, str(plugin), *words], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("width", [80, 140])
def test_its_tables_have_its_metric_its_measures_and_the_axes_of_its_world(
    plugin: Path, results: Path, monkeypatch: pytest.MonkeyPatch, width: int
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    lines = [line for name in ("run", "cells") for line in bench(plugin, "report", name, f"out={results}").splitlines()]
    text = "\n".join(lines)
    assert max(map(len, lines)) <= width
    assert "bends: 4 cells of 4 scenarios, 2 training seeds" in text
    for words in ("upright", "swing", "shove 0.2", "push 0.2: a perturbation of at most 0.2"):
        assert words in text
    assert "curvature" in text
    assert "× gap" in text
    rows = [line.strip().split("  ")[0] for line in lines]
    place = rows.index("0.1 × 10")
    assert rows[place : place + 4] == ["0.1 × 10", "0.1 × 20", "0.2 × 10", "0.2 × 20"]
    for words in ("best blind", "crashed", "lanes", "weather", "nan"):
        assert words not in text


def test_its_page_has_its_board_its_curve_and_the_axes_as_filters(plugin: Path, results: Path, browser: Any) -> None:
    page = results.parent / "page.html"
    said = bench(plugin, "report", f"out={results}", f"html={page}")
    assert "balancing in pole, bends, push 0.2, access scores, 10 queries" in said
    made = json.loads(page.with_suffix(".json").read_text())
    jsonschema.Draft202012Validator(document_schema()).validate(made)
    assert [(axis["name"], axis["values"]) for axis in made["boards"][0]["axes"]] == [
        ("curvature", [0.1, 0.2]),
        ("gap", [10, 20]),
    ]
    opened = browser.new_page()
    errors: list[str] = []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.goto(page.as_uri())
    assert opened.locator("#axes legend").all_inner_texts() == ["Curvature (1/m)", "Gap (m)"]
    assert opened.locator("#heat thead th").all_inner_texts() == ["Curvature", "10", "20"]
    whole = opened.locator("#ranks tbody tr td:nth-child(4)").inner_text()
    opened.locator("input[name=curvature][value='0.2']").uncheck()
    assert "2 of 4 cells" in opened.locator("#scope").inner_text()
    assert float(opened.locator("#ranks tbody tr td:nth-child(4)").inner_text().split()[0]) == pytest.approx(
        float(whole.split()[0]) + 0.05, abs=0.011
    )
    assert opened.locator("#curves figure").count() == 1
    opened.close()
    assert errors == []


def test_another_world_of_a_known_track_brings_its_axes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The baselines stand for every weather only where a world has weather."""
    from rich.console import Console

    from cavbench.leaderboard.terminal.run import cells_report, run_report

    cells = [Cell(lanes=3, density=1.0, weather="clear")]
    made = pa.concat_tables([drive(cells=cells), drive(attack="zo", cells=cells), baseline_drivers(cells)])
    facts = json.dumps({**Facts(axes=AXES, decision_hz=5, max_steps=50).written()})
    for name, value in (("cell", '{"curvature":0.1,"gap":10}'), ("world_facts", facts)):
        place = made.schema.get_field_index(name)
        made = made.set_column(place, made.schema.field(name), pa.array([value] * made.num_rows))
    run_report({"driving": made}, Console(width=120))
    cells_report({"driving": made}, Console(width=120))
    said = capsys.readouterr().out
    assert "0.1 × 10" in said
    assert "of 50" in said
    assert "best" in said
