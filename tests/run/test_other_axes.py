"""A world with axes of its own, three actions and five decisions a second needs no change anywhere else."""

from __future__ import annotations

import json
from pathlib import Path

from cavbench.core.track import track
from cavbench.records import reading
from tests.command import Bench

RUN = ("run", "attack=nudge", "victim=toy", "world=bend", "seeds=0,1", "executor=serial", "record=1")


def test_a_run_takes_its_axes_from_the_world(bench: Bench, tmp_path: Path) -> None:
    out = tmp_path / "results"
    said = bench(*RUN, "curvature=0.1,0.2", "--cells", f"out={out}")
    assert said.code == 0, said.err
    assert "curvature" in said.out
    assert "gap" in said.out
    rows = reading.read(out, track=track("driving")).to_pylist()
    cells = {row["cell"] for row in rows if row["attack"] == "nudge"}
    assert cells == {
        json.dumps({"curvature": c, "gap": g}, separators=(",", ":")) for c in (0.1, 0.2) for g in (20, 40)
    }
    facts = json.loads(rows[0]["world_facts"])
    assert (facts["decision_hz"], len(facts["actions"])) == (5.0, 3)
    assert [axis["name"] for axis in facts["axes"]] == ["curvature", "gap"]
    assert {len(row["action_counts"]) for row in rows} == {3}
    assert sorted(path.name for path in out.glob("recordings/nudge*/*.rrd"))[0] == "curvature-0.1-gap-20-1000000.rrd"


def test_its_baselines_are_its_own_constant_actions(bench: Bench, tmp_path: Path) -> None:
    out = tmp_path / "results"
    assert bench(*RUN, "curvature=0.1", "gap=20", "episodes=2", f"out={out}").code == 0
    rows = reading.read(out, track=track("driving")).to_pylist()
    facts = json.loads(rows[0]["world_facts"])
    blind = {json.loads(row["victim_params"])["policy"] for row in rows if row["victim"] == "blind"}
    assert blind == {name.lower() for name in facts["actions"]}


def test_its_axes_are_filters_of_the_page(bench: Bench, tmp_path: Path) -> None:
    out, page = tmp_path / "results", tmp_path / "page.html"
    assert bench(*RUN, f"out={out}").code == 0
    said = bench("report", f"out={out}", f"html={page}")
    assert said.code == 0, said.err
    (board,) = json.loads(page.with_suffix(".json").read_text())["boards"]
    assert [axis["name"] for axis in board["axes"]] == ["curvature", "gap"]
    assert len(board["rows"][0]["cells"]) == 6
    for axis in ("curvature", "gap"):
        assert axis in page.read_text()


def test_a_replay_finds_an_episode_by_its_axes(bench: Bench, tmp_path: Path) -> None:
    out = tmp_path / "results"
    assert bench(*RUN, "curvature=0.1,0.2", f"out={out}").code == 0
    said = bench("view", "nudge", "curvature=0.2", "gap=40", "seed=1000001", "--out", str(out))
    assert said.code == 0, said.err
    assert "Replayed bit for bit" in said.out


def test_what_is_not_on_an_axis_is_refused_in_one_line(bench: Bench) -> None:
    for word, line in {
        "curvature=2": "curvature must be a number between 0 and 1, got 2",
        "gap=1.5": "gap must be a whole number of at least 1, got 1.5",
        "lanes=3": "unknown axis 'lanes' of the world; known: curvature, gap",
        "curvatur=0.1": "unknown key 'curvatur'; did you mean 'curvature'?",
    }.items():
        said = bench(*RUN, word)
        assert said.code == 2
        assert said.err.startswith(f"error: {line}")
        assert len(said.err.strip().splitlines()) == 1
