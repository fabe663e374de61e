"""Recordings of the driving track, read back from their files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rerun.chunk import Chunk, RrdReader

from cavbench.driving import DrivingFacts, Features, ObservationThreat
from cavbench.driving.features import LaneShape
from cavbench.driving.recording import save
from cavbench.driving.recording.episode import Episode
from cavbench.driving.rollout import Trace
from cavbench.driving.threat import project
from cavbench.envs.highway.axes import AXES

FEATURES = Features(
    names=("x", "y", "vx", "vy"), low=(-100.0, -20.0, -40.0, -20.0), high=(100.0, 20.0, 40.0, 20.0),
    units=("m", "m", "m/s", "m/s"),
)  # fmt: skip
FACTS = DrivingFacts(
    axes=AXES,
    decision_hz=15,
    max_steps=450,
    actions=("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER"),
    features=FEATURES,
)
META = {
    "victim": "dqn", "victim_params": '{"hidden": 128}', "defense": "none", "attack": "noise", "attack_params": "{}",
    "threat_norm": "relative", "threat_budget": 0.1, "threat_access": "scores", "threat_queries": 100,
    "cell": '{"lanes":3,"density":1.0,"weather":"clear"}', "seed": 1_000_000, "training_seed": 0,
}  # fmt: skip
CARS = 4


def made_up(steps: int = 20, *, attacked: bool = True, discrete: bool = True, crash_at: int | None = None) -> Trace:
    """A trace of one episode with traffic that comes and goes."""
    generator = torch.Generator().manual_seed(0)
    trace = Trace(episodes=[0])
    for t in range(steps):
        observation = torch.rand(1, 1 + CARS, 5, generator=generator) * 1.6 - 0.8
        observation[..., 0] = 1.0
        observation[:, 1 + t % CARS :] = 0.0
        radius = ObservationThreat().radius(observation, FEATURES)
        perturbed = project(
            observation + 0.5 * torch.randn(observation.shape, generator=generator), observation, radius
        )
        scores = torch.randn(1, 5 if discrete else 2, generator=generator).tanh()
        crashed = crash_at is not None and t >= crash_at
        trace.append(
            {
                "observation": observation,
                "perturbed": perturbed if attacked else observation,
                "scores": scores,
                "clean_scores": scores.flip(-1),
                "action": scores.argmax(-1) if discrete else scores,
                "queries": torch.tensor([t]),
                "running": torch.tensor([crash_at is None or t <= crash_at]),
                "reward": torch.tensor([0.8]),
                "progress": torch.tensor([0.5]),
                "speed": torch.tensor([25.0]),
                "x": torch.tensor([100.0 + 25.0 * t / 15]),
                "ttc": torch.tensor([torch.inf if t % 2 else 3.0]),
                "crashed": torch.tensor([crashed]),
                "offroad": torch.tensor([False]),
            }
        )
    return trace


def read(path: Path) -> dict[str, list[Chunk]]:
    """The chunks of a recording by entity."""
    chunks: dict[str, list[Chunk]] = {}
    for chunk in RrdReader(path).stream():
        chunks.setdefault(str(chunk.entity_path), []).append(chunk)
    return chunks


def values(chunks: list[Chunk], component: str) -> list[object]:
    """The column of the component whose name ends with `component`: a list of instances for each step."""
    for chunk in chunks:
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.endswith(component) and not chunk.is_static:
                return batch.column(name).to_pylist()
    raise AssertionError(f"no component {component}")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "episode.rrd"


def test_every_entity_is_one_block_of_columns_over_both_timelines(path: Path) -> None:
    save(made_up(20), facts=FACTS, meta=META, path=path)
    chunks = read(path)
    assert {"/ego/measured", "/ego/shown", "/traffic/measured", "/traffic/shown", "/queries/spent"} <= set(chunks)
    for entity, found in chunks.items():
        temporal = [chunk for chunk in found if not chunk.is_static]
        assert len(temporal) <= 1, f"{entity} was logged step by step"
        for chunk in temporal:
            assert chunk.num_rows == 20
            assert set(chunk.timeline_names) == {"step", "time"}


def test_time_is_in_seconds(path: Path) -> None:
    save(made_up(16), facts=FACTS, meta=META, path=path)
    (chunk,) = (chunk for chunk in read(path)["/speed/ego"] if not chunk.is_static)
    time = chunk.to_record_batch().column("time").to_pylist()
    assert time[-1].total_seconds() == pytest.approx(1.0, abs=1e-6)


def test_time_follows_the_decision_rate_of_the_world(path: Path) -> None:
    save(made_up(16), facts=replace(FACTS, decision_hz=5), meta=META, path=path)
    (chunk,) = (chunk for chunk in read(path)["/speed/ego"] if not chunk.is_static)
    time = chunk.to_record_batch().column("time").to_pylist()
    assert time[-1].total_seconds() == pytest.approx(3.0, abs=1e-6)


def test_actions_have_the_names_of_the_world(path: Path) -> None:
    names = ("A", "B", "C", "D", "E")
    save(made_up(16), facts=replace(FACTS, actions=names), meta=META, path=path)
    chunks = read(path)
    assert {f"/scores/shown/{name}" for name in names} <= set(chunks)
    assert {state[0] for state in values(chunks["/decision/taken"], "state")} <= set(names)


def test_the_page_says_what_the_recording_is_of(path: Path) -> None:
    save(made_up(16), facts=FACTS, meta=META, path=path)
    (page,) = (chunk.to_record_batch() for chunk in read(path)["/about"])
    text = next(page.column(name)[0].as_py()[0] for name in page.schema.names if name.endswith("text"))
    assert "### dqn under noise · lanes 3, density 1, clear · seed 1000000" in text
    assert "**drove to the end** after 16 steps (1.1 s)" in text
    assert "**threat model** relative 0.1, access scores, at most 100 queries per step" in text


def test_ghosts_stand_where_the_perturbation_puts_them(path: Path) -> None:
    trace = made_up(8)
    save(trace, facts=FACTS, meta=META, path=path)
    chunks = read(path)
    shown = values(chunks["/traffic/shown"], "strips")
    measured = values(chunks["/traffic/measured"], "strips")
    for t in range(8):
        offset = (trace.steps["perturbed"][t] - trace.steps["observation"][t])[0, 1:, 1:3]
        offset = offset[trace.steps["observation"][t][0, 1:, 0] > 0] * np.array([100.0, 20.0])
        middles = np.asarray(measured[t]).reshape(-1, 2, 2).mean(1)
        # An outline of five points, the last of which is the first one.
        ghosts = np.asarray(shown[t]).reshape(-1, 5, 2)[:, :4].mean(1)
        np.testing.assert_allclose(ghosts - middles, offset, atol=1e-3)


def points(chunks: dict[str, list[Chunk]], entity: str) -> list[np.ndarray]:
    """The strips of an entity as points [N, 2], for each step."""
    return [np.concatenate([np.asarray(strip) for strip in strips]) for strips in values(chunks[entity], "strips")]


def test_a_road_that_bends_stands_and_the_ego_drives_in_it(path: Path) -> None:
    angles = np.linspace(0, 2 * np.pi, 40)
    ring = tuple((float(90 * np.cos(angle)), float(90 * np.sin(angle))) for angle in angles)
    trace, features = made_up(6), replace(FEATURES, low=(-160.0,) * 2 + (-30.0,) * 2, high=(160.0,) * 2 + (30.0,) * 2)
    save(trace, facts=replace(FACTS, features=features, lanes=(LaneShape(width=4.0, line=ring),)), meta=META, path=path)
    chunks = read(path)
    assert all(chunk.is_static for chunk in chunks["/road/surface"])
    for t, strip in enumerate(points(chunks, "/ego/measured")):
        place, speed = np.split(trace.steps["observation"][t][0, 0, 1:] * ([160.0] * 2 + [30.0] * 2), 2)
        np.testing.assert_allclose(strip.mean(0), place, atol=1e-2)
        length = strip[1] - strip[0]
        np.testing.assert_allclose(length / np.linalg.norm(length), speed / np.linalg.norm(speed), atol=1e-3)


def test_a_ramp_beside_a_straight_road_goes_by_with_the_ego(path: Path) -> None:
    road = LaneShape(width=4.0, line=((0.0, 0.0), (1000.0, 0.0)))
    ramp = LaneShape(width=4.0, line=((150.0, 14.0), (190.0, 11.0), (230.0, 8.0)))
    save(made_up(6), facts=replace(FACTS, lanes=(road, ramp)), meta=META, path=path)
    for t, strip in enumerate(points(read(path), "/road/surface")):
        x = 100.0 + 25.0 * t / 15
        np.testing.assert_allclose(strip[:2], [[-60, 0], [140, 0]], atol=1e-3)
        np.testing.assert_allclose(strip[2:], np.array(ramp.line) - [x, 0], atol=1e-2)


def test_the_perturbation_never_leaves_its_budget(path: Path) -> None:
    save(made_up(12), facts=FACTS, meta=META, path=path)
    chunks = read(path)
    for group, feature in (("position", "x"), ("position", "y"), ("velocity", "vx"), ("velocity", "vy")):
        moved, budget = (
            np.asarray(values(chunks[f"/perturbation/{group}/{feature}{end}"], "scalars")).ravel()
            for end in ("", "_budget")
        )
        assert (moved <= budget + 1e-4).all()
        assert moved.max() > 0


def test_the_decision_band_names_the_clean_and_the_taken_action(path: Path) -> None:
    trace = made_up(10)
    save(trace, facts=FACTS, meta=META, path=path)
    chunks = read(path)
    taken = [state[0] for state in values(chunks["/decision/taken"], "state")]
    assert taken == [FACTS.actions[int(step[0])] for step in trace.steps["action"]]
    clean = [state[0] for state in values(chunks["/decision/clean"], "state")]
    assert clean == [FACTS.actions[int(step[0].argmax())] for step in trace.steps["clean_scores"]]


def test_an_episode_ends_at_its_crash(path: Path) -> None:
    trace = made_up(20, crash_at=6)
    save(trace, facts=FACTS, meta=META, path=path)
    (chunk,) = (chunk for chunk in read(path)["/ego/measured"] if not chunk.is_static)
    assert chunk.num_rows == 7
    assert Episode.of(trace, FACTS, META).end == "crashed"


def test_a_clean_episode_has_no_ghosts_and_no_budget(path: Path) -> None:
    save(made_up(attacked=False), facts=FACTS, meta={}, path=path)
    assert not [entity for entity in read(path) if "shown" in entity.split("/")[-1] or "perturbation" in entity]


def test_continuous_actions_are_recorded_as_acceleration_and_steering(path: Path) -> None:
    save(made_up(discrete=False), facts=FACTS, meta=META, path=path)
    assert {"/scores/shown/acceleration", "/scores/measured/steering"} <= set(read(path))


def test_a_recording_opens_with_a_layout_of_its_own(path: Path) -> None:
    save(made_up(), facts=FACTS, meta=META, path=path)
    assert len(list(RrdReader(path).blueprints())) == 1


def test_the_file_appears_whole_or_not_at_all(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("the disk is full")

    monkeypatch.setattr("cavbench.driving.recording.curves.log", broken)
    with pytest.raises(RuntimeError, match="disk"):
        save(made_up(), facts=FACTS, meta=META, path=path)
    assert list(path.parent.iterdir()) == []


def test_a_recording_holds_one_episode(path: Path) -> None:
    trace = made_up()
    with pytest.raises(ValueError, match="one episode"):
        save(Trace(episodes=[0, 1], steps=trace.steps), facts=FACTS, meta=META, path=path)


def test_observations_without_positions_are_recorded_without_a_road(path: Path) -> None:
    nameless = Features(
        names=("a", "b", "c", "d"), low=FEATURES.low, high=FEATURES.high, units=("m", "m", "m/s", "m/s")
    )
    save(made_up(), facts=replace(FACTS, features=nameless), meta=META, path=path)
    entities = set(read(path))
    assert "/perturbation/position/a" in entities
    assert not [entity for entity in entities if entity.startswith(("/road", "/traffic"))]
