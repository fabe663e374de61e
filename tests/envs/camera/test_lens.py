"""Drops, glare and motion blur: maps of the linear light, drawn from the seed of a pose."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from cavbench.core.pair import Pair, choose
from cavbench.core.track import Job
from cavbench.detection import PatchThreat
from cavbench.detection.drive import drive
from cavbench.detection.patch import Patch
from cavbench.envs.camera import lens, poses
from cavbench.envs.camera.lens import EFFECTS
from cavbench.envs.camera.windscreen import Windscreen, WindscreenScenes
from cavbench.envs.camera.windscreen_axes import AXES, LENSES, WINDSCREEN_V1
from cavbench.envs.camera.world import StopSignApproach
from cavbench.envs.weather import WEATHERS
from tests.envs.camera.scenes import scenes

POSES = poses.approach("sun-behind-ego", 3, 1.0, "sun")
FRAMES = torch.tensor([0, 9])
CLEAR, RAIN = WEATHERS["clear"], WEATHERS["rain"]
STREET = scenes()


def light(seed: int) -> Tensor:
    return torch.rand(2, 3, 384, 1248, generator=torch.Generator().manual_seed(seed))


def through(name: str) -> WindscreenScenes:
    return WindscreenScenes(STREET, [name] * len(STREET))


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_is_affine_in_light_and_all_but_glare_are_linear(name: str) -> None:
    def effect(light: Tensor) -> Tensor:
        return EFFECTS[name](light, [POSES[0], POSES[9]], [CLEAR, RAIN])

    first, second, dark = light(0), light(1), torch.zeros(2, 3, 384, 1248)
    mixed = effect(0.3 * first + 0.5 * second)
    expected = 0.3 * effect(first) + 0.5 * effect(second) + 0.2 * effect(dark)
    torch.testing.assert_close(mixed, expected, atol=1e-5, rtol=0)
    assert bool(effect(dark).any()) == (name == "glare")


@pytest.mark.parametrize("name", ["drops", "blur"])
def test_even_light_stays_as_it_is_away_from_the_border(name: str) -> None:
    even = torch.full((1, 3, 384, 1248), 0.4)
    seen = EFFECTS[name](even, [POSES[5]], [CLEAR])[..., 20:-20, 20:-20]
    torch.testing.assert_close(seen, even[..., 20:-20, 20:-20], atol=1e-5, rtol=0)


def test_a_drop_shows_the_street_upside_down_and_spares_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    pose, half = POSES[1], 40.0
    alone = torch.tensor([[624.0, 192.0]]).double().numpy(), torch.tensor([[half, half]]).double().numpy()
    monkeypatch.setattr(lens, "_drawn", lambda pose, rate: alone)
    lens._sheet.cache_clear()
    sky_over_road = torch.zeros(1, 3, 384, 1248)
    sky_over_road[..., :192, :] = 1
    seen = lens.drops(sky_over_road, [pose], [CLEAR])[0, 0]
    lens._sheet.cache_clear()
    assert float(seen[192 - 20, 624]) < 0.3
    assert float(seen[192 + 20, 624]) > 0.7
    assert torch.equal(seen[:, :500], sky_over_road[0, 0, :, :500])


def test_drops_are_those_of_the_pose_and_as_many_as_fall_between_two_wipes() -> None:
    rate = RAIN.precipitation_mm_h
    numbers = [len(lens._drawn(pose, rate)[0]) for pose in poses.scored()]
    assert [len(lens._drawn(pose, rate)[0]) for pose in poses.scored()[:5]] == numbers[:5]
    assert len(set(numbers)) > 20
    assert 210 < sum(numbers) / len(numbers) < 240


def test_rain_leaves_more_and_larger_drops_than_a_shower_that_has_passed() -> None:
    even = torch.zeros(len(POSES), 3, 384, 1248)
    even[..., :192, :] = 1
    changed = [(lens.drops(even, POSES, [weather] * len(POSES)) - even).abs().mean() for weather in (CLEAR, RAIN)]
    assert changed[1] > 1.5 * changed[0] > 0
    rates = (lens.SHOWER_MM_H, RAIN.precipitation_mm_h)
    widths = [np.concatenate([lens._drawn(pose, rate)[1][:, 0] for pose in POSES]) for rate in rates]
    assert len(widths[1]) > 1.5 * len(widths[0])
    assert widths[1].mean() > widths[0].mean()


def test_motion_blur_spares_the_focus_of_expansion_and_grows_towards_the_sign() -> None:
    stripes = (torch.arange(1248) % 8 < 4).float().expand(1, 3, 384, 1248)
    contrast = lens.blur(stripes, [POSES[9]], [CLEAR])[0, 0, 200].unfold(0, 8, 8).std(1)
    middle = round(float(lens._expansion(POSES[9].camera)[0])) // 8
    assert float(contrast[middle]) > 2 * float(contrast[middle + 28])


def test_a_nearer_sun_adds_more_veil() -> None:
    veil = lens._veil(POSES[0])
    assert float(veil[0, 0].max()) > 5 * float(veil[0, -1].max())
    assert torch.equal(veil, lens._veil(POSES[9])), "the sun of a place stands still"


def test_a_clean_lens_shows_the_frames_of_the_world_camera_bit_for_bit() -> None:
    values: dict[str, int | float | str] = {"lanes": 3, "density": 1.0, "weather": "rain"}
    (clean,) = Windscreen().approaches(AXES.cell(**values), range(1))
    (camera,) = StopSignApproach().approaches(StopSignApproach.axes.cell(**values), range(1))
    patch = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    assert torch.equal(clean.scenes.render(FRAMES, patch, 0.5), camera.scenes.render(FRAMES, patch, 0.5))
    assert torch.equal(clean.scenes.render_decoys(FRAMES), camera.scenes.render_decoys(FRAMES))


@pytest.mark.parametrize("name", EFFECTS)
def test_the_gradient_reaches_the_texels_and_is_the_slope(name: str) -> None:
    seen, frame = through(name), torch.tensor([8])
    patch = torch.full((1, 3, 8, 8), 0.5, requires_grad=True)
    weights = torch.randn(3, 384, 1248, generator=torch.Generator().manual_seed(0))

    def loss(value: Tensor) -> Tensor:
        return (seen.render(frame, value, 0.5)[0] * weights).sum()

    (gradient,) = torch.autograd.grad(loss(patch), patch)
    assert (gradient != 0).all()
    direction = torch.randn(patch.shape, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        slope = (loss(patch + 0.02 * direction) - loss(patch - 0.02 * direction)) / 0.04
    assert float((gradient * direction).sum()) == pytest.approx(float(slope), rel=0.05)


def test_frames_with_different_lenses_are_rendered_together() -> None:
    mixed = WindscreenScenes(STREET, [LENSES[number % 4] for number in range(len(STREET))])
    together = mixed.render(torch.tensor([0, 1, 2, 3]), None, 0.5)
    for number, name in enumerate(LENSES):
        assert torch.equal(together[number], through(name).render(torch.tensor([number]), None, 0.5)[0])


def test_attacks_see_every_lens_on_training_places_only() -> None:
    training = Windscreen().training_scenes()
    assert isinstance(training, WindscreenScenes)
    assert set(training.lenses) == set(LENSES) == set(WINDSCREEN_V1.values["lens"])
    scored = {pose.seed for pose in poses.scored()}
    assert not scored & {pose.seed for pose in training.street.poses}


def test_a_run_scores_a_patch_through_drops() -> None:
    pair = Pair(
        attack=choose("attack", "grey_patch"),
        defense=choose("defense", "none"),
        victim=choose("victim", "yolov3_tiny"),
        world=choose("world", "windscreen"),
        threat=PatchThreat(budget=0.5),
    )
    cell = AXES.cell(lanes=3, density=1.0, weather="rain", lens="drops")
    job = Job(pair=pair, training_seed=0, attack_seed=0, cell=cell, seeds=range(1))
    driven = drive(job, Patch(texels=torch.full((3, 8, 8), 0.3)).written(""), ())
    assert len(driven.columns["frame_confidence"][0]) == 10
    assert 0 < driven.columns["confidence_mean"][0] < 1
    assert driven.columns["inconsistent"][0] == 0
