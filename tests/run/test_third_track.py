"""A third-party track, with its own axes, is listed, run, resumed, recorded and reported."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from cavbench.core import registry
from cavbench.core.track import track
from tests.command import Bench
from tests.plugins.distributions import install
from tests.tree import PLUGINS

POINTS = {
    "cavbench.tracks": {"listening": "listening_plugin:ListeningTrack"},
    "cavbench.grids": {"melodies-v1": "listening_plugin:MELODIES"},
    "cavbench.worlds": {"booth": "listening_plugin:Booth"},
    "cavbench.victims": {"ear": "listening_plugin:Ear"},
    "cavbench.attacks": {"down": "listening_plugin:Down"},
}
RUN = ("run", "attack=down", "victim=ear", "seeds=0", "threat.budget=0.3", "executor=serial")


@pytest.fixture(autouse=True)
def third_track(plugins: Path) -> Iterator[None]:
    install(
        plugins,
        "cavbench-listening",
        POINTS,
        {"listening_plugin": (PLUGINS / "toy_track.py").read_text()},
    )
    registry.installed.cache_clear()
    track.cache_clear()
    yield
    track.cache_clear()


def test_its_components_are_listed_with_their_track(bench: Bench) -> None:
    said = bench("list")
    assert said.code == 0
    for name in ("booth", "ear", "down"):
        (line,) = [line for line in said.out.splitlines() if f" {name} " in f" {line} "]
        assert "listening" in line
    assert "Track: listening" in bench("list", "down").out


def test_a_run_is_driven_recorded_reported_and_resumed(bench: Bench, tmp_path: Path) -> None:
    out = tmp_path / "results"
    said = bench(*RUN, f"out={out}")
    assert said.code == 0, said.err
    assert "tones heard" in said.out
    shown = bench("show", str(out), "--cells").out
    assert "highest" in shown
    assert "pitch" in shown
    files = sorted(out.glob("episodes/*.parquet"))
    assert len(files) == 4
    records = pq.read_table(files[0])
    assert records.schema.metadata[b"track"] == b"listening"
    assert set(records["cell"].to_pylist()) <= {'{"pitch":1.0,"tones":8}', '{"pitch":2.0,"tones":8}'}
    before = {path: path.stat().st_mtime_ns for path in files}
    files[0].unlink()
    assert bench(*RUN, f"out={out}").code == 0
    after = {path: path.stat().st_mtime_ns for path in out.glob("episodes/*.parquet")}
    assert set(after) == set(before)
    assert [path for path in files if after[path] != before[path]] == [files[0]]


def test_its_axes_are_keys_of_the_command_line(bench: Bench, tmp_path: Path) -> None:
    said = bench(*RUN, "pitch=1.2", "tones=4,6", "episodes=2", f"out={tmp_path / 'results'}")
    assert said.code == 0, said.err
    cells = {pq.read_table(path)["cell"][0].as_py() for path in tmp_path.glob("results/episodes/*.parquet")}
    assert cells == {'{"pitch":1.2,"tones":4}', '{"pitch":1.2,"tones":6}'}
    refused = bench(*RUN, "lanes=3", f"out={tmp_path / 'results'}")
    assert refused.code == 2
    assert refused.err.startswith("error: unknown axis 'lanes' of the world; ")
    assert refused.err.endswith("known: pitch, tones\n")
    assert "pitch must be a number above 0, got -1" in bench(*RUN, "pitch=-1", f"out={tmp_path / 'results'}").err
    assert "pitch a number above 0 of the lower tone" in " ".join(bench("run", "--help").out.split())


def test_its_records_are_shown_on_the_page(bench: Bench, tmp_path: Path) -> None:
    out = tmp_path / "results"
    assert bench(*RUN, f"out={out}").code == 0
    said = bench("report", f"out={out}", f"html={tmp_path / 'page.html'}")
    assert said.code == 0, said.err
    page = (tmp_path / "page.html").read_text()
    assert "listening" in page
    assert "pitch" in page


def test_an_attack_of_another_track_does_not_fit(bench: Bench) -> None:
    said = bench("run", "attack=noise", "victim=ear")
    assert said.code == 2
    assert "attack 'noise' does not fit victim 'ear' of the listening track; fitting: down, none" in said.err


def test_a_results_folder_holds_both_tracks(bench: Bench, tmp_path: Path) -> None:
    out = tmp_path / "results"
    assert bench(*RUN, f"out={out}").code == 0
    driving = (
        "run",
        "victim=blind",
        "lanes=3",
        "density=1",
        "weather=clear",
        "episodes=2",
        "reference=false",
        "executor=serial",
    )
    assert bench(*driving, f"out={out}").code == 0
    said = bench("report", f"out={out}")
    assert said.code == 0, said.err
    assert "tones heard" in said.out
    assert "safe progress" in said.out
    shutil.rmtree(out)
