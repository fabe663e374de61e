"""The world `crossing` with its shipped frames: from the patch to the collision, as records and as a film."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from cavbench.core.contracts import Facts
from cavbench.core.pair import Chosen, Pair, choose
from cavbench.core.track import Driven, Job, track
from cavbench.detection import Detector, DetectorVictim, PatchThreat, Predictions
from cavbench.detection.closed_loop import drive as drive_car
from cavbench.detection.closed_loop import measured
from cavbench.detection.drive import drive, drive_jointly
from cavbench.detection.patch import Patch
from cavbench.envs.camera import sign
from cavbench.envs.camera.crossing import StopSignCrossing
from cavbench.envs.camera.crossing_axes import AXES, CROSSING_V2
from cavbench.envs.camera.street import layout
from cavbench.envs.camera.windscreen import WindscreenScenes
from cavbench.recording.film import save
from cavbench.recording.film.drawing import BLUE, VERMILLION

WORLD = StopSignCrossing()
GREY = torch.full((3, 8, 8), 0.3)
SEEDS = range(1_000_000, 1_000_040)


class RedPlate(Detector):
    """Finds what is red to the right of the lane: the vehicles with their red lamps wait on its left."""

    names = ("stop sign",)
    stride = 1

    def predict(self, pictures: Tensor) -> Predictions:
        boxes, found = [], []
        for picture in pictures:
            red, others = picture[0], picture[1:].amax(0)
            rows, columns = torch.where((red > 0.3) & (red > 1.8 * others))
            inside = columns > picture.shape[2] / 2
            rows, columns = rows[inside].float(), columns[inside].float()
            found.append(float(len(rows) > 50))
            ends = torch.tensor([0.02, 0.98])
            corners = [columns.quantile(ends), rows.quantile(ends)] if len(rows) else [ends, ends]
            # The rim is white, and a fiftieth is left out at each end: the red is 0.89 of the width of the sign.
            low, high = torch.stack(corners, 1)
            margin = (high - low) * (1 / 0.89 - 1) / 2
            boxes.append(torch.cat([low - margin, high + margin]))
        shape = (len(pictures), 1)
        return Predictions(torch.stack(boxes)[:, None], torch.tensor(found).view(shape), torch.ones(*shape, 1))


class Blind(Detector):
    """Sees nothing, and counts the images that it is asked about."""

    names = ("stop sign",)
    stride = 1
    asked: ClassVar[int] = 0

    def predict(self, pictures: Tensor) -> Predictions:
        Blind.asked += len(pictures)
        shape = (len(pictures), 1)
        return Predictions(torch.zeros(*shape, 4), torch.zeros(shape), torch.ones(*shape, 1))


@dataclass(frozen=True, kw_only=True)
class ToyVictim(DetectorVictim):
    """The victim of `RedPlate`, or of `Blind`."""

    blind: bool = False

    def load(self, seed: int, facts: Facts) -> Detector:
        return (Blind() if self.blind else RedPlate()).eval()


def job(speed: float = 10.0, blind: bool = False) -> Job:
    pair = Pair(
        attack=choose("attack", "grey_patch"),
        defense=choose("defense", "none"),
        victim=Chosen(kind="victim", name="red_plate", component=ToyVictim(blind=blind), code="test"),
        world=choose("world", "crossing"),
        threat=PatchThreat(budget=1.0),
    )
    return Job(pair=pair, training_seed=0, attack_seed=0, cell=AXES.cell(weather="clear", speed=speed), seeds=SEEDS)


@pytest.fixture(scope="module")
def attacked() -> Driven:
    """A grey patch as large as the sign."""
    return drive(job(), Patch(texels=GREY).written(""), SEEDS[:1])


@pytest.fixture(scope="module")
def clean() -> Driven:
    return drive(job(), None, ())


def test_every_frame_of_the_road_ships_and_neighbours_are_a_metre_apart_or_half_of_it() -> None:
    for weather in CROSSING_V2.values["weather"]:
        first, second = WORLD.approaches(AXES.cell(weather=weather, speed=10.0), range(2))
        assert first.scenes is second.scenes
        assert float(first.scenes.distance.diff().abs().max()) <= 1.0
        assert float(first.scenes.distance[first.scenes.distance <= 30].diff().abs().max()) <= 0.5
        assert float(first.scenes.distance.max()) == 60.0
        assert float(first.scenes.visible.min()) > 0.9


def test_the_traffic_obeys_the_sign_and_leaves_the_lane_of_the_car_free() -> None:
    for placed in layout.traffic(layout.LOCATIONS["crossing"], 3, 1.0):
        assert placed.speed == 0
        assert placed.x < -layout.LANE_M / 2 - 0.5
        assert placed.later(10.0) == placed.y < 0


def test_frames_of_a_standing_street_grow_smoothly() -> None:
    """From one frame to the next the sign grows as the projection says, and the picture changes little."""
    scenes = WORLD.approaches(AXES.cell(weather="clear", speed=10.0), range(1))[0].scenes
    width = (scenes.boxes[:, 2] - scenes.boxes[:, 0]) * scenes.distance
    torch.testing.assert_close(width, torch.full_like(width, float(width[0])), rtol=0.01, atol=0)
    # 31.5 to 29 m, where frames come to be half a metre apart, and are of two renderings.
    for frames in (torch.arange(0, 4), torch.arange(28, 32)):
        pictures = scenes.render(frames, None, 0.5)
        assert float((pictures[1:] - pictures[:-1]).abs().mean()) < 0.05


def test_the_environment_knows_how_wide_a_sign_is() -> None:
    """The focal length in pixels times the width in metres."""
    env = WORLD.environment(AXES.cell(weather="fog"), range(1), None, 0.5)
    assert env.sign_px_m == pytest.approx(721.0 * sign.SIZE_M, rel=0.01)
    assert env.step_s == pytest.approx(0.05)


def test_lenses_are_those_of_the_windscreen() -> None:
    """Clean frames are the street's, bit for bit; drops and blur change them."""
    scenes = {
        lens: WORLD.approaches(AXES.cell(weather="rain", lens=lens), range(1))[0].scenes
        for lens in ("clean", "drops", "blur")
    }
    frames = torch.tensor([40])
    shown = {lens: one.render(frames, None, 0.5) for lens, one in scenes.items()}
    assert torch.equal(shown["clean"], WindscreenScenes(scenes["clean"], ["clean"] * 75).render(frames, None, 0.5))
    assert float((shown["drops"] - shown["clean"]).abs().mean()) > 0.01
    assert not torch.equal(shown["blur"], shown["clean"])


def test_traffic_that_does_not_react_is_hit_more_often() -> None:
    scores = []
    for reaction in (0.75, 100.0):
        env = StopSignCrossing(reaction=reaction).environment(AXES.cell(speed=8.0), range(300), GREY, 1.0)
        scores.append(drive_car(RedPlate(), env))
    attentive, blind = scores
    assert not attentive.stopped
    assert attentive.braked.any()
    assert not blind.braked.any()
    assert 0 < attentive.collided.mean() < blind.collided.mean()


@pytest.mark.parametrize("reaction", [-1.0, 101.0, float("nan")])
def test_impossible_reaction_times_are_refused_in_one_line(reaction: float) -> None:
    with pytest.raises(ValueError, match=r"crossing\.reaction must be from 0 to 100 s, got"):
        StopSignCrossing(reaction=reaction)


def test_a_patch_sends_the_car_into_the_cross_traffic_and_without_it_the_car_stops(
    attacked: Driven, clean: Driven
) -> None:
    assert clean.columns["stopped"].all()
    assert not clean.columns["collided"].any()
    assert (clean.columns["drive_confirmed_m"] > 25).all()
    assert not attacked.columns["stopped"].any()
    assert 0 < attacked.columns["collided"].mean() < 1
    assert (attacked.columns["drive_overrun_m"] > layout.CROSSING[1]).all()
    assert (attacked.columns["confidence_mean"] < clean.columns["confidence_mean"]).all()


def test_the_closed_loop_confirms_where_the_open_loop_does(attacked: Driven, clean: Driven) -> None:
    for driven in (attacked, clean):
        np.testing.assert_allclose(driven.columns["drive_confirmed_m"], driven.columns["confirmed_m"], atol=1e-3)


def test_a_world_without_a_closed_loop_has_empty_columns() -> None:
    assert choose("world", "camera").component.environment(job().cell, SEEDS, None, 0.5) is None
    assert all(np.isnan(values).all() for values in measured(None, 2).values())


def test_the_film_shows_camera_and_road_side_by_side(attacked: Driven, tmp_path: Path) -> None:
    film = track("detection").film(job(), attacked.traces[SEEDS[0]], {"victim": "red_plate", "seed": SEEDS[0]})
    assert film.fps == pytest.approx(20.0)
    assert len(film) > 60
    first, second = film.pictures(2)
    assert first.shape[1] > 1100
    road = first[:, 770:]
    assert (road == np.array(VERMILLION)).all(-1).sum() > 300, "the car under the attack"
    assert (road == np.array(BLUE)).all(-1).sum() > 300, "the car without it"
    assert not np.array_equal(road, second[:, 770:])
    save(film, tmp_path / "drive.webp", seconds=(0, 0.5))
    assert Image.open(tmp_path / "drive.webp").n_frames == 5


def test_three_speeds_ask_about_little_more_than_one() -> None:
    """They see the same frames: 75 with the patch, 75 decoys, 75 faces, nine probes, and 75 in the loop."""
    jobs = [job(speed, blind=True) for speed in CROSSING_V2.values["speed"]]
    assert len({track("detection").alike(one) for one in jobs}) == 1
    Blind.asked = 0
    alone = drive(jobs[1], None, ())
    once, Blind.asked = Blind.asked, 0
    together = drive_jointly(jobs, {})
    assert together is not None
    assert Blind.asked == once
    assert once == 4 * 75 + 9
    for name, values in alone.columns.items():
        np.testing.assert_array_equal(together[1].columns[name], values, err_msg=name)


def test_speeds_outside_of_the_axis_are_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match="speed must be a number between 4 and 14, got 30"):
        AXES.cell(weather="clear", speed=30.0)
