"""The decoys of the camera world: other faces in the light of the sign, and a post without one."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import torch

from cavbench.envs.camera import faces, training_faces
from cavbench.envs.camera.develop import light_of, tone
from cavbench.envs.camera.world import StopSignApproach
from tests.envs.camera.scenes import scenes

NEAREST = torch.tensor([9])


def with_decoy(name: str) -> torch.Tensor:
    """The nearest frame of a grey street, with this decoy on its post."""
    made = scenes()
    made.decoys = tuple(one for one in faces.DECOYS if one.name == name) * len(made)
    return made.render_decoys(NEAREST)[0]


def test_light_is_the_inverse_of_the_tone_curve() -> None:
    light = torch.linspace(0, 3, 50)
    torch.testing.assert_close(light_of(tone(light)), light, rtol=1e-3, atol=1e-4)


def test_a_decoy_changes_the_sign_and_nothing_else() -> None:
    made = scenes()
    x0, y0, x1, y1 = made.frames[9].crop
    signed = made.render(NEAREST, None, 0.5)[0]
    for decoy in faces.DECOYS:
        changed = (with_decoy(decoy.name) - signed).abs().amax(0) > 0.02
        assert changed[y0:y1, x0:x1].float().mean() > 0.2, decoy.name
        changed[y0:y1, x0:x1] = False
        assert not changed.any(), decoy.name


def test_training_decoys_are_others_than_the_scored_ones_and_two_of_five_are_octagons() -> None:
    scenes = StopSignApproach().training_scenes()
    decoys = scenes.decoys
    assert not {one.name for one in (*decoys, *scenes.redrawn(1).decoys)} & {one.name for one in faces.DECOYS}
    assert not set(decoys) & set(scenes.redrawn(1).decoys)
    assert scenes.redrawn(0).decoys == decoys
    rounds = [one.octagonal for number in range(5) for one in scenes.redrawn(number).decoys]
    assert np.mean(rounds) == pytest.approx(0.4, abs=0.05)
    pictures = [training_faces.drawn(one.name) for one in decoys[:20]]
    for first, second in combinations(pictures, 2):
        assert any((a != b).any() for a, b in zip(first, second, strict=True))
    again, _ = training_faces.drawn(decoys[0].name)
    assert (again == pictures[0][0]).all()


def test_only_training_decoys_of_other_outlines_are_red_from_rim_to_rim() -> None:
    """A red octagon with a patch may be a stop sign; a red disc is not, and looks like a no-entry sign."""
    red = {"octagonal": 0, "other": 0}
    for one in training_faces.decoys(0, 200):
        picture, cover = training_faces.drawn(one.name)
        reds, greens, blues = picture[cover > 0].reshape(-1, 3).T.astype(float)
        if len(reds):
            share = ((reds > 120) & (reds > 2 * greens) & (reds > 2 * blues)).mean()
            red["octagonal" if one.octagonal else "other"] += share > 0.75
    assert red["octagonal"] == 0
    assert red["other"] >= 3


def test_without_a_sign_the_background_is_seen_and_around_a_triangle_too() -> None:
    made = scenes()
    x0, y0, x1, y1 = made.frames[9].crop
    background = made.render(NEAREST, None, 0.5)[0][:, y0:y1, x0 - 8 : x0 - 4].mean(2, keepdim=True)
    bare, triangle = (with_decoy(name)[:, y0:y1, x0:x1] for name in ("nothing", "yield"))
    # The horizon behind the sign is guessed as a gradient.
    assert ((bare - background).abs().amax(0) < 0.06).float().mean() > 0.75
    height, width = bare.shape[1:]
    corner = triangle[:, -height // 4 :, width // 6 : width // 4]
    assert ((corner - background[:, -height // 4 :]).abs().amax(0) < 0.06).all()
    assert ((triangle - background).abs().amax(0) > 0.1).float().mean() > 0.3


def test_every_decoy_is_on_the_post_of_some_scored_frame_and_octagons_are_as_many_as_others() -> None:
    world = StopSignApproach()
    shown = [
        decoy.name
        for lanes in (3, 4, 5)
        for approach in world.approaches(world.axes.cell(lanes=lanes, density=1.0, weather="fog"), range(3))
        for decoy in approach.scenes.decoys
    ]
    assert set(shown) == {decoy.name for decoy in faces.DECOYS}
    octagonal = {decoy.name for decoy in faces.DECOYS if decoy.octagonal}
    assert 0.4 < np.mean([name in octagonal for name in shown]) < 0.7
