"""The world `roundabout` from the command line: a driver is trained on it, attacked, recorded and filmed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from cavbench.core.track import track
from cavbench.envs.roads.network import record
from cavbench.envs.roads.roundabout import DESTINATIONS, LEFT, RADIUS, RIGHT, STRAIGHT, roundabout, spots, way
from cavbench.records import reading
from tests.command import Bench

CELL = ("turn=straight", "density=1", "radius=20", "weather=clear")


@pytest.mark.slow
def test_a_driver_is_trained_attacked_and_recorded(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    said = bench("train", "victim=dqn", "victim.decisions=64", "world=roundabout", "seeds=0")
    assert said.code == 0, said.err
    own = (
        "victim.decisions=64",
        "victim.trained_in=roundabout",
        "attack=noise,pgd",
        "world.max_steps=40",
        "executor=serial",
    )
    said = bench(
        "run",
        "world=roundabout",
        "victim=dqn",
        *own,
        *CELL,
        "episodes=2",
        "seeds=0",
        "record=1",
        f"out={tmp_path / 'out'}",
    )
    assert said.code == 0, said.err
    rows = reading.read(tmp_path / "out", track=track("driving")).to_pylist()
    assert {row["attack"] for row in rows} == {"none", "noise", "pgd"}
    assert {row["victim"] for row in rows} == {"dqn", "blind", "random", "idm"}
    assert all(0 <= row["safe_progress"] <= 1 and row["distance_m"] >= 0 for row in rows)
    (recording, *_) = sorted((tmp_path / "out").rglob("*.rrd"))
    entities = {str(chunk.entity_path) for chunk in RrdReader(recording).stream()}
    assert {"/road/surface", "/ego/measured", "/traffic/measured"} <= entities
    said = bench("view", str(recording), "--save", str(tmp_path / "film.webp"))
    assert (tmp_path / "film.webp").exists(), said.err


@pytest.mark.parametrize(("goal", "roads"), [(RIGHT, 5), (STRAIGHT, 7), (LEFT, 9)])
def test_a_way_is_as_long_as_its_roads(goal: int, roads: int) -> None:
    network, road = roundabout(connected=True), way(goal)
    assert len(road.roads) == roads
    table = record(network, spots=spots(network), destinations=DESTINATIONS, way=road)[0]
    start = network.number("ser", "ses", 0)
    length = sum(network.graph[first][last][0].length for first, last in road.roads[:-1]) + road.goal
    assert table["way_after"][start] + table["way_length"][start] == pytest.approx(length)


def test_another_radius_moves_the_arms_and_keeps_how_they_meet_the_ring() -> None:
    gaps = []
    for radius in (16.0, RADIUS, 45.0):
        network = roundabout(connected=True, radius=radius)
        entry, ring = network.graph["ses"]["se"][0], network.graph["se"]["ex"][1]
        gaps.append(ring.position(0, 0) - entry.position(entry.length, 0))
    np.testing.assert_allclose(gaps, [gaps[1]] * 3, atol=1e-9)
