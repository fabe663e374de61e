"""Victims from a file: they drive like the exported policy, and a file that does not fit is refused in one line."""

from __future__ import annotations

import base64
import json
import os
import pickle
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from bench.conformance import complaints
from bench.driving.drive import drive
from bench.driving.rollout import Columns
from bench.errors import UserError
from bench.plugins.pair import choose
from bench.run.config import run_config
from bench.run.plan import plan
from envs.highway.world import HighwayWorld

FACTS = HighwayWorld().facts

ALGORITHMS = [
    ("dqn", False),
    ("ppo", False),
    ("ppo", True),
    ("a2c", False),
    ("sac", True),
    ("td3", True),
    ("ddpg", True),
]
SHORT = "lanes=3 density=2 weather=clear episodes=3 seeds=0 world.max_steps=40 reference=false"


class Scores(nn.Module):
    """The zoo's DQN as a user would export it, or a network of another width."""

    def __init__(self, outputs: int = 5, *, flat: bool = False) -> None:
        super().__init__()
        self.policy = choose("victim", "dqn").component.load(0, FACTS)
        self.outputs, self.flat = outputs, flat

    def forward(self, observation: Tensor) -> Tensor:
        observation = observation.reshape(-1, 10, 5) if self.flat else observation
        return self.policy.scores(observation)[:, : self.outputs]


def torch_file(
    path: Path, network: nn.Module | None = None, shape: tuple[int, ...] = (10, 5), *, fixed: bool = False
) -> str:
    dynamic = None if fixed else {"observation": {0: torch.export.Dim("batch")}}
    program = torch.export.export(network or Scores(), (torch.rand(3, *shape),), dynamic_shapes=dynamic)
    torch.export.save(program, path)
    return str(path)


def onnx_file(
    path: Path, network: nn.Module | None = None, shape: tuple[int, ...] = (10, 5), *, fixed: bool = False
) -> str:
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    dynamic = None if fixed else {"observation": {0: torch.export.Dim("batch")}}
    torch.onnx.export(
        network or Scores(),
        (torch.rand(3, *shape),),
        path,
        dynamic_shapes=dynamic,
        input_names=["observation"],
        external_data=False,
        verbose=False,
    )
    return str(path)


def spaces(*, continuous: bool, shape: tuple[int, ...] = (10, 5), high: float = 1.0) -> gymnasium.Env[Any, Any]:
    """A dummy environment with these spaces."""
    env: gymnasium.Env[Any, Any] = gymnasium.Env()
    env.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)
    box = gymnasium.spaces.Box(-high, high, (2,), np.float32)
    env.action_space = box if continuous else gymnasium.spaces.Discrete(5)
    return env


def sb3_model(algo: str, env: gymnasium.Env[Any, Any], **policy: object) -> Any:
    """A model of Stable-Baselines3 with random weights, large enough that its actions vary."""
    sb3 = pytest.importorskip("stable_baselines3")
    model = getattr(sb3, algo.upper())("MlpPolicy", env, device="cpu", seed=0, policy_kwargs=policy)
    with torch.no_grad():
        for weight in model.policy.parameters():
            weight.add_(0.1 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(weight.numel())))
    return model


def sb3_file(path: Path, algo: str, *, continuous: bool = False, **policy: object) -> str:
    sb3_model(algo, spaces(continuous=continuous), **policy).save(path)
    return str(path)


def driven(*words: str) -> Columns:
    """The measurements of the first unit of these options, without the wall time."""
    unit = next(unit for unit in plan(run_config([*SHORT.split(), *words])))
    return {name: column for name, column in drive(unit.job, []).columns.items() if name != "attack_ms"}


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> str:
    return torch_file(tmp_path_factory.mktemp("torch") / "policy.pt2")


@pytest.fixture(scope="module")
def onnx(tmp_path_factory: pytest.TempPathFactory) -> str:
    return onnx_file(tmp_path_factory.mktemp("onnx") / "policy.onnx")


@pytest.mark.slow
@pytest.mark.parametrize("attack", ["none", "zo", "pgd"])
def test_an_exported_dqn_drives_exactly_like_the_zoos(exported: str, attack: str) -> None:
    own, ours = driven(f"attack={attack}", "victim=torch", f"victim.path={exported}"), driven(f"attack={attack}")
    for name in ours:
        np.testing.assert_array_equal(own[name], ours[name], err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("attack", ["none", "zo"])
def test_a_dqn_in_an_onnx_file_decides_like_the_zoos(onnx: str, attack: str) -> None:
    own, ours = driven(f"attack={attack}", "victim=onnx", f"victim.path={onnx}"), driven(f"attack={attack}")
    for name in ("steps", "crashed", "offroad", "action_counts", "distance_m", "queries"):
        np.testing.assert_array_equal(own[name], ours[name], err_msg=name)


def test_a_gradient_attack_on_a_black_box_is_refused_before_any_work() -> None:
    with pytest.raises(UserError, match="victim 'onnx' is a black box that supports 'scores' at most"):
        run_config(["attack=pgd", "victim=onnx", "victim.path=nowhere.onnx"])
    run_config(["attack=zo", "victim=onnx", "victim.path=nowhere.onnx"])


@pytest.mark.parametrize(("algo", "continuous"), ALGORITHMS)
def test_a_policy_of_stable_baselines_acts_like_its_own_predict(tmp_path: Path, algo: str, continuous: bool) -> None:
    policy: dict[str, object] = {"activation_fn": nn.ELU} if algo == "ppo" and continuous else {}
    model = sb3_model(algo, spaces(continuous=continuous), **policy)
    model.save(tmp_path / "model.zip")
    actions = "continuous" if continuous else "discrete"
    victim = choose("victim", "sb3", path=str(tmp_path / "model.zip"), algo=algo, actions=actions).component
    observation = 2 * torch.rand(200, 10, 5, generator=torch.Generator().manual_seed(0)) - 1
    wanted, _ = model.predict(observation.numpy(), deterministic=True)
    decided = victim.load(0, FACTS).decide(observation)
    assert len(np.unique(wanted, axis=0)) > 1
    torch.testing.assert_close(decided, torch.from_numpy(wanted), rtol=0, atol=1e-6)


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
def test_victims_from_files_keep_the_rules(exported: str, onnx: str, tmp_path: Path) -> None:
    assert complaints("victim", "torch", **{"path": exported}) == []
    assert complaints("victim", "onnx", **{"path": onnx}) == []
    assert complaints("victim", "sb3", path=sb3_file(tmp_path / "dqn.zip", "dqn"), algo="dqn") == []
    path = sb3_file(tmp_path / "sac.zip", "sac", continuous=True)
    assert complaints("victim", "sb3", path=path, algo="sac") == []


def test_a_network_with_flat_input_receives_flat_observations(tmp_path: Path) -> None:
    path = torch_file(tmp_path / "flat.pt2", Scores(flat=True), shape=(50,))
    observation = torch.rand(2, 3, 10, 5)
    flat = choose("victim", "torch", path=path).component.load(0, FACTS)
    assert torch.equal(flat.scores(observation), choose("victim", "dqn").component.load(0, FACTS).scores(observation))
    assert flat.scores(observation[:0]).shape == (0, 3, 5)


def bad_text(path: Path) -> dict[str, str]:
    path.write_text("nothing of the kind")
    return {"path": str(path)}


BAD: dict[str, tuple[str, Callable[[Path], dict[str, str]], str]] = {
    "no file": ("torch", lambda path: {"path": str(path)}, "there is no file"),
    "no program": ("torch", bad_text, "cannot be read"),
    "fixed batch": (
        "torch",
        lambda path: {"path": torch_file(path, fixed=True)},
        "has a fixed batch size of 3: export it",
    ),
    "rows": (
        "torch",
        lambda path: {"path": torch_file(path), "rows": "15"},
        "takes observations [10, 5], victim.rows and victim.features say [15, 5] or [75]",
    ),
    "two scores": (
        "torch",
        lambda path: {"path": torch_file(path, Scores(2))},
        "returns [1, 2] for 1 observation, discrete actions need [1, 5]",
    ),
    "other actions": (
        "torch",
        lambda path: {"path": torch_file(path), "actions": "continuous"},
        "returns [1, 5] for 1 observation, continuous actions need [1, 2]",
    ),
    "no rows": ("torch", lambda path: {"path": str(path), "rows": "0"}, "rows must be at least 1"),
    "no onnx": ("onnx", bad_text, "cannot be read"),
    "fixed onnx": ("onnx", lambda path: {"path": onnx_file(path, fixed=True)}, "has a fixed batch size of 3"),
    "no zip": ("sb3", lambda path: bad_text(path) | {"algo": "dqn"}, "cannot be read: it is not a zip archive"),
    "unknown algo": ("sb3", lambda path: {"path": str(path), "algo": "dqm"}, "unknown victim.algo 'dqm'"),
    "no algo": ("sb3", lambda path: {"path": str(path)}, "needs victim.algo=…"),
    "another algo": (
        "sb3",
        lambda path: {"path": sb3_file(path, "dqn"), "algo": "ppo"},
        "has no ppo policy: mlp_extractor.policy_net is not among its weights",
    ),
    "continuous": (
        "sb3",
        lambda path: {"path": sb3_file(path, "ppo", continuous=True), "algo": "ppo"},
        "was trained for continuous actions [2], this ppo victim needs 5 discrete actions; set victim.actions=continuous",
    ),
    "other rows": (
        "sb3",
        lambda path: {"path": sb3_file(path, "dqn"), "algo": "dqn", "rows": "5"},
        "takes observations [10, 5], victim.rows and victim.features say [5, 5] or [25]",
    ),
    "own activation": (
        "sb3",
        lambda path: {"path": sb3_file(path, "dqn", activation_fn=Softer), "algo": "dqn"},
        "is not one of torch's",
    ),
}


class Softer(nn.ReLU):
    """An activation of the user's own."""


@pytest.mark.parametrize("what", BAD)
def test_a_file_that_does_not_fit_is_refused_in_one_line(tmp_path: Path, what: str) -> None:
    from bench.run.config import component

    name, make, part = BAD[what]
    with pytest.raises(UserError) as raised:
        component("victim", name, make(tmp_path / "file.zip")).load(0, FACTS)
    assert part in str(raised.value)
    assert "\n" not in str(raised.value)


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


def test_without_onnx_runtime_the_error_has_the_install_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    (tmp_path / "policy.onnx").write_bytes(b"")
    with pytest.raises(UserError, match=r"needs ONNX Runtime: pip install 'cavbench\[onnx\]'"):
        choose("victim", "onnx", path=str(tmp_path / "policy.onnx")).component.load(0, FACTS)
