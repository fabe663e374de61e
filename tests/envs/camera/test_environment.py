"""The approach as a TorchRL environment."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from cavbench.envs.camera.braking import Brakes
from cavbench.envs.camera.environment import ApproachEnv
from tests.envs.camera.scenes import scenes


@pytest.fixture(scope="module")
def env() -> ApproachEnv:
    return ApproachEnv([scenes(), scenes(lanes=4)], brakes=Brakes(greatest=8.0, jerk=math.inf))


def _driven(env: ApproachEnv, braking: float, after: int = 0) -> list[TensorDict]:
    td, steps = env.reset(), []
    for number in range(40):
        td["action"] = torch.full((2, 1), braking if number >= after else 0.0)
        td = env.step(td)["next"]
        steps.append(td)
        if bool(td["done"].all()):
            break
    return steps


def test_specs(env: ApproachEnv) -> None:
    check_env_specs(env)


def test_without_braking_it_meets_every_frame_and_runs_the_sign(env: ApproachEnv) -> None:
    steps = _driven(env, 0.0)
    seen = [30.0, *(float(step["info", "distance"][0]) for step in steps)]
    assert seen[:10] == pytest.approx(env.distances.tolist(), abs=1e-3)
    assert bool(steps[-1]["done"].all())
    assert not any(step["reward"].any() for step in steps)
    assert float(steps[-1]["info", "distance"].max()) < 0


@pytest.mark.parametrize(("braking", "stops"), [(8.0, True), (2.0, True), (1.6, False)])
def test_it_stops_within_the_distance_that_physics_gives(env: ApproachEnv, braking: float, stops: bool) -> None:
    steps = _driven(env, braking)
    rest = 30.0 - 10.0**2 / (2 * braking)
    assert (rest > 0) == stops
    assert bool(steps[-1]["reward"].all()) == stops
    if stops:
        assert float(steps[-1]["info", "distance"][0]) == pytest.approx(rest, abs=1e-2)


def test_the_patch_is_on_the_sign() -> None:
    plain, patched = ApproachEnv([scenes()]), ApproachEnv([scenes()], torch.zeros(1, 3, 8, 8))
    x0, y0, x1, y1 = (int(edge) for edge in plain.scenes[0].boxes[0])
    difference = (plain.reset()["observation"] - patched.reset()["observation"]).abs()[0]
    assert difference[:, y0:y1, x0:x1].mean() > 0.02
    difference[:, y0:y1, x0:x1] = 0
    assert not difference.any()


def test_a_frame_is_rendered_when_the_car_comes_near_it_and_shown_until_it_has_left_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    own = scenes()
    env, render, rendered = ApproachEnv([own, own], brakes=Brakes(greatest=8.0, jerk=math.inf)), own.render, []

    def counted(frames: torch.Tensor, patches: torch.Tensor | None, share: float) -> torch.Tensor:
        rendered.append(int(frames))
        return render(frames, patches, share)

    monkeypatch.setattr(own, "render", counted)
    steps = _driven(env, 3.0)
    frames = [int(step["info", "frame"][0]) for step in steps]
    assert len(set(frames)) < len(frames)
    assert rendered == [frame for frame in dict.fromkeys((0, *frames)) for _ in range(2)]
    for step, frame in zip(steps, frames, strict=True):
        torch.testing.assert_close(step["observation"][1], render(torch.tensor([frame]), None, 0.5)[0], rtol=0, atol=0)
