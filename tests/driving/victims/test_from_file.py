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

from cavbench.checks import complaints
from cavbench.core.pair import choose
from cavbench.driving.drive import drive
from cavbench.driving.rollout import Columns
from cavbench.driving.victims.in_process import in_process
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from cavbench.run.config import plan_of

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


class Fewer(nn.Module):
    """A network of 5 rows."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(25, 5)

    def forward(self, observation: Tensor) -> Tensor:
        return self.linear(observation.flatten(1))


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


def spaces(
    *, continuous: bool, shape: tuple[int, ...] = (10, 5), high: float = 1.0, seen: float = 1.0
) -> gymnasium.Env[Any, Any]:
    """A dummy environment with these spaces: observations in [-seen, seen], actions in [-high, high]."""
    env: gymnasium.Env[Any, Any] = gymnasium.Env()
    env.observation_space = gymnasium.spaces.Box(-seen, seen, shape, np.float32)
    box = gymnasium.spaces.Box(-high, high, (2,), np.float32)
    env.action_space = box if continuous else gymnasium.spaces.Discrete(5)
    return env


def sb3_model(algo: str, env: gymnasium.Env[Any, Any], **policy: object) -> Any:
    """A model of Stable-Baselines3 with random weights, large enough that its actions vary."""
    sb3 = pytest.importorskip("stable_baselines3")
    sde = {"use_sde": policy.pop("use_sde")} if "use_sde" in policy else {}
    model = getattr(sb3, algo.upper())("MlpPolicy", env, device="cpu", seed=0, policy_kwargs=policy, **sde)
    with torch.no_grad():
        for weight in model.policy.parameters():
            weight.add_(0.1 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(weight.numel())))
    return model


def sb3_file(path: Path, algo: str, *, continuous: bool = False, **policy: object) -> str:
    sb3_model(algo, spaces(continuous=continuous), **policy).save(path)
    return str(path)


def driven(*words: str) -> Columns:
    """The measurements of the first unit of these options, without the wall time."""
    unit = next(unit for unit in plan_of([*SHORT.split(), *words]).units())
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
        plan_of(["attack=pgd", "victim=onnx", "victim.path=nowhere.onnx"])
    plan_of(["attack=zo", "victim=onnx", "victim.path=nowhere.onnx"])


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
        "victim.rows=15 is not this world's observation, which has 10 rows of 5 features",
    ),
    "features": (
        "torch",
        lambda path: {"path": torch_file(path), "features": "7"},
        "victim.features=7 is not this world's observation, which has 10 rows of 5 features",
    ),
    "no world": (
        "torch",
        lambda path: {"path": str(path), "trained_in": "' '"},
        "trained_in must be the world of the training",
    ),
    "another arrangement": (
        "torch",
        lambda path: {"path": torch_file(path, Scores(flat=True), (5, 10))},
        "takes observations (5, 10), this world shows (10, 5), or flattened (50,); these are as many numbers in another",
    ),
    "fewer rows": (
        "torch",
        lambda path: {"path": torch_file(path, Fewer(), (5, 5))},
        "takes observations (5, 5), this world shows (10, 5)",
    ),
    "fewer rows in onnx": (
        "onnx",
        lambda path: {"path": onnx_file(path, Fewer(), (5, 5))},
        "takes observations (5, 5), this world shows (10, 5)",
    ),
    "two scores": (
        "torch",
        lambda path: {"path": torch_file(path, Scores(2))},
        "discrete actions need [1, 5]; if these are acceleration and steering, set victim.actions=continuous",
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
    "another algo": (
        "sb3",
        lambda path: {"path": sb3_file(path, "dqn"), "algo": "ppo"},
        "is a model of dqn, victim.algo says ppo; leave victim.algo out",
    ),
    "continuous": (
        "sb3",
        lambda path: {"path": sb3_file(path, "ppo", continuous=True), "actions": "discrete"},
        "has continuous actions, victim.actions says discrete; leave victim.actions out",
    ),
    "other rows": (
        "sb3",
        lambda path: {"path": sb3_file(path, "dqn"), "algo": "dqn", "rows": "5"},
        "victim.rows=5 is not this world's observation",
    ),
    "highway-env's default": (
        "sb3",
        lambda path: saved(path, "dqn", spaces(continuous=False, shape=(5, 5), seen=np.inf)),
        "was trained on Box(-inf, inf, (5, 5)), this world shows Box(-1, 1, (10, 5)); highway-env's own tasks",
    ),
    "other bounds": (
        "sb3",
        lambda path: saved(path, "ppo", spaces(continuous=False, seen=np.inf)),
        "was trained on Box(-inf, inf, (10, 5)), this world shows Box(-1, 1, (10, 5)); highway-env's own tasks",
    ),
    "two frames": (
        "sb3",
        lambda path: saved(path, "dqn", spaces(continuous=False, shape=(5, 10))),
        'another arrangement. Train it in cavbench.gym.make("highway")',
    ),
    "other range of actions": (
        "sb3",
        lambda path: saved(path, "sac", spaces(continuous=True, high=2.0)),
        'actions in Box(-2, 2, (2,)), not in [-1, 1]. Train it in cavbench.gym.make("highway", action_type="continuous")',
    ),
    "three actions": (
        "sb3",
        lambda path: saved(path, "dqn", with_actions(gymnasium.spaces.Discrete(3))),
        "was trained for 3 discrete actions, this world takes 5 discrete ones (LANE_LEFT, IDLE,",
    ),
    "actions from 1": (
        "sb3",
        lambda path: saved(path, "ppo", with_actions(gymnasium.spaces.Discrete(5, start=1))),
        "numbers its actions from 1; they must be numbered from 0",
    ),
    "many actions": (
        "sb3",
        lambda path: saved(path, "ppo", with_actions(gymnasium.spaces.MultiDiscrete([5, 5]))),
        "was trained for actions of MultiDiscrete; the type must be Discrete or Box",
    ),
    "own extractor": (
        "sb3",
        lambda path: {"path": sb3_file(path, "ppo", features_extractor_class=extractor())},
        "has the features extractor",
    ),
    "own activation": (
        "sb3",
        lambda path: {"path": sb3_file(path, "dqn", activation_fn=Softer), "algo": "dqn"},
        "is not one of torch's",
    ),
}


def saved(path: Path, algo: str, env: gymnasium.Env[Any, Any]) -> dict[str, str]:
    sb3_model(algo, env).save(path)
    return {"path": str(path)}


def with_actions(space: gymnasium.Space[Any]) -> gymnasium.Env[Any, Any]:
    env = spaces(continuous=False)
    env.action_space = space
    return env


def extractor() -> type[nn.Module]:
    """A features extractor that computes what `Flatten` does, in code of its own."""
    layers = pytest.importorskip("stable_baselines3.common.torch_layers")
    return type("Own", (layers.FlattenExtractor,), {})


class Softer(nn.ReLU):
    """An activation of the user's own."""


@pytest.mark.parametrize("what", BAD)
def test_a_file_that_does_not_fit_is_refused_in_one_line(tmp_path: Path, what: str) -> None:
    from cavbench.run.config import component

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


class TwoOutputs(nn.Module):
    """A mean and the logarithm of a deviation, as SAC's actors return, or logits and a value."""

    def __init__(self, other: int) -> None:
        super().__init__()
        self.first, self.other = nn.Linear(50, 2), nn.Linear(50, other)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        return self.first(observation.flatten(1)), self.other(observation.flatten(1))


@pytest.mark.parametrize(("other", "fits"), [(1, True), (2, False)])
def test_an_onnx_file_with_two_outputs_that_could_drive_is_refused(other: int, fits: bool, tmp_path: Path) -> None:
    path = onnx_file(tmp_path / "two.onnx", TwoOutputs(other))
    victim = choose("victim", "onnx", path=path, actions="continuous").component
    if fits:
        assert victim.load(0, FACTS).scores(torch.zeros(3, 10, 5)).shape == (3, 2)
        return
    with pytest.raises(UserError, match="of 2 numbers each: export the one that drives alone"):
        victim.load(0, FACTS)


def test_without_onnx_runtime_the_error_has_the_install_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    (tmp_path / "policy.onnx").write_bytes(b"")
    with pytest.raises(UserError, match=r"needs ONNX Runtime: pip install 'cavbench\[onnx\]'"):
        choose("victim", "onnx", path=str(tmp_path / "policy.onnx")).component.load(0, FACTS)
