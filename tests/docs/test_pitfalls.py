"""The lines of docs/pitfalls.md that cavbench depends on hold for the installed libraries, and each finding is on the page.

If an upgrade fails here, the library changed. Look whether what cavbench does about it is still right, then change page,
finding and test.
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from typing import Any

import gymnasium
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Categorical
from torchrl.envs import MultiStepTransform, StepCounter, TransformedEnv
from torchrl.modules import MLP, QValueActor

from cavbench.envs.highway.keys import decisions
from cavbench.envs.highway.world import HighwayWorld
from tests.tree import ROOT

PAGE = (ROOT / "docs" / "pitfalls.md").read_text()
FINDINGS = sorted(path for path in (ROOT / "findings").glob("*.sh") if path.name != "fresh.sh")


def test_every_finding_is_on_the_page_and_the_page_names_no_other() -> None:
    assert {path.stem for path in FINDINGS} == set(re.findall(r"finding `(\w+)`", PAGE))


@pytest.mark.parametrize("path", FINDINGS, ids=lambda path: path.stem)
def test_a_finding_says_what_it_is_and_pins_what_it_installs(path: Path) -> None:
    text = path.read_text()
    head = text.split("source ")[0]
    for part in ("One guesses:", "What happens:", "Versions:", "Source:"):
        assert part in head
    ((node, installed),) = re.findall(r"^fresh(_node)? (.*)$", text, re.MULTILINE)
    assert all(("@" if node else "==") in one for one in installed.split() if one != "numpy")
    assert "cavbench" not in text
    subprocess.run(["bash", "-n", path], check=True)
    if not node:
        compile(text.split("see <<'P'\n")[1].removesuffix("P\n"), path.name, "exec")


def crash() -> TensorDict:
    """Three steps of one episode, whose last one is a crash: batch size [1, 3]."""
    end = torch.tensor([False, False, True])[None, :, None]
    reward = torch.tensor([0.0, 0.0, -1.0])[None, :, None]
    return TensorDict(
        {
            "observation": torch.arange(3.0)[None, :, None],
            "next": {
                "observation": torch.arange(1.0, 4.0)[None, :, None],
                "reward": reward,
                "done": end,
                "terminated": end,
            },
        },
        [1, 3],
    )


@pytest.mark.parametrize(("options", "terminated"), [({}, False), ({"done_keys": []}, True)])
def test_the_n_step_transform_tells_of_a_crash_only_without_done_keys(options: Any, terminated: bool) -> None:
    transform = MultiStepTransform(n_steps=3, gamma=0.9, **options)
    found = transform.inv(torch.cat([crash(), crash(), crash()], 1))
    assert bool(found["next", "terminated"][0, 0]) is terminated
    assert found["next", "reward"][0, 0].item() == pytest.approx(-0.81)


def test_a_transformed_env_drops_the_scenario_of_a_reset() -> None:
    world = HighwayWorld(max_steps=5)
    cells = [world.axes.cell(lanes=3, density=1.0)] * 2
    asked = TensorDict({"seed": torch.tensor([3, 4])}, [2])
    seen = {}
    for name, env in {"alone": world.make(cells), "behind": TransformedEnv(world.make(cells), StepCounter())}.items():
        seen[name] = [env.reset(asked.clone())["observation"] for _ in range(2)]
    assert torch.equal(*seen["alone"])
    assert not torch.equal(*seen["behind"]), (
        "docs/pitfalls.md and the comment in test_torchrl_examples.py are out of date"
    )


@pytest.mark.parametrize("rate", [5, 3])
def test_a_configuration_of_highway_env_has_its_number_of_decisions(rate: int) -> None:
    config = {"duration": 30, "policy_frequency": rate, "simulation_frequency": 15, "vehicles_count": 0}
    gymnasium.register_envs(pytest.importorskip("highway_env"))
    env = gymnasium.make("highway-fast-v0", config=config)
    env.reset(seed=0)
    there = next(step for step in range(1, 200) if env.step(1)[3])
    assert there == decisions(30.0, rate) == 30 * rate + 1


def test_a_clamp_passes_the_gradient_of_black_and_white_pixels_and_a_hardtanh_does_not() -> None:
    found = {}
    for name, clamped in {"clamp": torch.clamp, "hardtanh": torch.nn.functional.hardtanh}.items():
        pixels = torch.tensor([0.0, 1.0], requires_grad=True)
        clamped(pixels, 0.0, 1.0).sum().backward()
        assert pixels.grad is not None
        found[name] = pixels.grad.tolist()
    assert found == {"clamp": [1.0, 1.0], "hardtanh": [0.0, 0.0]}, (
        "patches that start black or white are crafted otherwise"
    )


def test_an_actor_that_is_called_by_name_cannot_be_exported_with_a_dynamic_batch() -> None:
    actor = QValueActor(MLP(in_features=6, out_features=3), in_keys=["observation"], spec=Categorical(3))
    shapes = {"kwargs": {"observation": {0: torch.export.Dim("batch")}}}
    with pytest.raises(AssertionError):
        torch.export.export(actor, (), {"observation": torch.rand(2, 6)}, dynamic_shapes=shapes, strict=False)


def test_dqn_does_not_train_on_frames_of_normalised_observations() -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

    env = VecFrameStack(VecNormalize(DummyVecEnv([lambda: gymnasium.make("CartPole-v1")])), 3)
    with pytest.raises(ValueError, match="could not broadcast input array"):
        sb3.DQN("MlpPolicy", env, learning_starts=2, buffer_size=20, device="cpu").learn(5)
