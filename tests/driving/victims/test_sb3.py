"""Victims of Stable-Baselines3 act like its own `predict`, have its critic, and only their tensors are unpickled."""

from __future__ import annotations

import base64
import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from cavbench.core.pair import choose
from cavbench.driving.victims.in_process import in_process
from cavbench.driving.victims.sb3_saved import saved_model
from cavbench.errors import UserError
from tests.checks.rules import broken
from tests.driving.victims.policy_files import (
    FACTS,
    driven,
    sb3_file,
    sb3_model,
    spaces,
)

ALGORITHMS = [
    ("dqn", False),
    ("ppo", False),
    ("ppo", True),
    ("a2c", False),
    ("sac", True),
    ("td3", True),
    ("ddpg", True),
]


FAITHFUL: list[tuple[str, bool, dict[str, Any]]] = [
    *((algo, continuous, {}) for algo, continuous in ALGORITHMS),
    ("a2c", True, {}),
    ("ppo", True, {"activation_fn": nn.ELU, "net_arch": []}),
    ("ppo", True, {"use_sde": True}),
    ("ppo", True, {"use_sde": True, "squash_output": True}),
    ("a2c", True, {"use_sde": True, "squash_output": True, "use_expln": True, "full_std": False}),
    ("sac", True, {"use_sde": True}),
    ("sac", True, {"use_sde": True, "clip_mean": 0.7}),
    ("sac", True, {"use_sde": True, "clip_mean": 0.0}),
    ("td3", True, {"net_arch": {"pi": [30], "qf": [20, 20]}, "n_critics": 1}),
]


@pytest.mark.parametrize(("algo", "continuous", "policy"), FAITHFUL)
def test_a_policy_of_stable_baselines_acts_like_its_own_predict_as_a_file_and_as_an_object(
    tmp_path: Path, algo: str, continuous: bool, policy: dict[str, Any]
) -> None:
    model = sb3_model(algo, spaces(continuous=continuous), **policy)
    model.save(tmp_path / "model.zip")
    observation = 2 * torch.rand(100, 10, 5, generator=torch.Generator().manual_seed(0)) - 1
    wanted, _ = model.predict(observation.numpy(), deterministic=True)
    assert len(np.unique(wanted, axis=0)) > 1
    if continuous:
        assert np.abs(wanted).max() > 0.5, "squashing would not matter"
    victim = choose("victim", "sb3", path=str(tmp_path / "model.zip")).component
    assert victim.action_type == ("continuous" if continuous else "discrete")
    given = in_process([model], FACTS, observation, None)
    for policy_ in (victim.load(0, FACTS), given.load(0, FACTS)):
        for _ in range(2):
            torch.testing.assert_close(policy_.decide(observation), torch.from_numpy(wanted), rtol=0, atol=2e-6)


@pytest.mark.parametrize("algo", ["sac", "td3"])
def test_a_policy_of_stable_baselines_has_its_critic(tmp_path: Path, algo: str) -> None:
    model = sb3_model(algo, spaces(continuous=True))
    model.save(tmp_path / "model.zip")
    policy = choose("victim", "sb3", path=str(tmp_path / "model.zip"), algo=algo).component.load(0, FACTS)
    observation, action = torch.rand(7, 10, 5), torch.rand(7, 2)
    with torch.no_grad():
        wanted = model.policy.critic(observation, action)[0].squeeze(-1)
        torch.testing.assert_close(policy.value(observation, action), wanted)


@pytest.mark.slow
@pytest.mark.parametrize(("algo", "continuous"), [("dqn", False), ("ppo", False), ("sac", True)])
def test_attacks_reach_a_policy_of_stable_baselines(tmp_path: Path, algo: str, continuous: bool) -> None:
    words = (
        "victim=sb3",
        f"victim.algo={algo}",
        f"victim.path={sb3_file(tmp_path / 'm.zip', algo, continuous=continuous)}",
    )
    for attack in ("zo", "pgd"):
        measured = driven(f"attack={attack}", "threat.norm=linf", "threat.budget=0.2", *words)
        assert measured["queries"].min() > 1
        assert measured["changed"].max() > 0


@pytest.mark.slow
@pytest.mark.parametrize(("algo", "continuous"), [("dqn", False), ("sac", True)])
def test_it_keeps_the_rules(algo: str, continuous: bool, tmp_path: Path) -> None:
    path = sb3_file(tmp_path / "model.zip", algo, continuous=continuous)
    assert broken("victim", "sb3", path=path, algo=algo) == {}


class Harm:
    """Touches a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def test_only_tensors_of_a_saved_model_are_unpickled(tmp_path: Path) -> None:
    path, harm = Path(sb3_file(tmp_path / "dqn.zip", "dqn")), tmp_path / "harm"
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(entries["data"])
    for value in data.values():
        if isinstance(value, dict) and ":serialized:" in value:
            value[":serialized:"] = base64.b64encode(pickle.dumps(Harm(harm))).decode()

    def load(**changed: bytes) -> None:
        with zipfile.ZipFile(path, "w") as archive:
            for name, blob in {**entries, "data": json.dumps(data).encode(), **changed}.items():
                archive.writestr(name, blob)
        choose("victim", "sb3", path=str(path), algo="dqn").component.load(0, FACTS)

    load()
    torch.save({"q_net.q_net.0.weight": Harm(harm)}, tmp_path / "policy.pth")
    with pytest.raises(UserError, match=r"it is not a model of Stable-Baselines3"):
        load(**{"policy.pth": (tmp_path / "policy.pth").read_bytes()})
    assert not harm.exists()


@pytest.mark.parametrize("algo", ["DQN", "PPO", "A2C"])
def test_a_policy_of_a_dict_says_what_to_type(tmp_path: Path, algo: str) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.envs import BitFlippingEnv

    path = tmp_path / "dict.zip"
    getattr(sb3, algo)("MultiInputPolicy", BitFlippingEnv(n_bits=3, max_steps=3), device="cpu").save(path)
    with pytest.raises(UserError, match=rf"has a MultiInputPolicy.*cavbench\.score\(stable_baselines3\.{algo}\.load\("):
        saved_model(str(path))
