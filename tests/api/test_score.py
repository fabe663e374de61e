"""`cavbench.score` scores what a caller has at hand, with the records of the command."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import pytest
import torch
from torch import Tensor, nn

import cavbench
from cavbench.core.contracts import Access
from cavbench.core.pair import choose
from cavbench.core.track import track
from cavbench.driving import ActionType, DrivingAttack, Oracle, Policy
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from cavbench.isolation.modes import USUAL, numbers
from cavbench.records import reading
from cavbench.run import runner
from cavbench.run.config import plan_of
from tests.driving.victims.policy_files import sb3_model, spaces
from tests.isolation.torch_modes import CALLERS

PGD = cavbench.component("attack", "pgd", steps=1, restarts=1)
SHORT = HighwayWorld(max_steps=15)
WHERE: dict[str, Any] = {"lanes": 3, "density": 1, "weather": "clear", "episodes": 2, "world": SHORT}


class Brakes(nn.Module):
    """A network that prefers SLOWER, by a constant of this module."""

    def __init__(self, *, scale: float = 1.0) -> None:
        super().__init__()
        self.scale, self.linear = scale, nn.Linear(5, 5)
        nn.init.constant_(self.linear.weight, 0.1)

    def forward(self, observation: Tensor) -> Tensor:
        return self.scale * (self.linear(observation[:, 0]) + torch.eye(5)[4])


class Controls(nn.Module):
    def forward(self, flat: Tensor) -> Tensor:
        return flat[:, :2] * 0.1 if flat.shape[1:] == (50,) else flat.new_zeros(3)


@dataclass(frozen=True, kw_only=True)
class Still(DrivingAttack):
    """Shows cars that do not move."""

    access: ClassVar[Access] = "oblivious"
    action_types: ClassVar[tuple[ActionType, ...]] = ("discrete",)

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        still = observation.clone()
        still[..., 3:] = 0
        return oracle.project(still)


@pytest.fixture
def score(tmp_path: Path) -> Callable[..., Any]:
    def call(*given: Any, **options: Any) -> Any:
        return cavbench.score(*given, **{**WHERE, "baselines": False, "out": tmp_path, **options})

    return call


def test_it_writes_the_records_of_the_command(tmp_path: Path, score: Callable[..., Any]) -> None:
    found = score("dqn", "noise", seeds=[0])
    words = "attack=noise lanes=3 density=1 weather=clear episodes=2 seeds=0 world.max_steps=15 reference=false"
    config = plan_of([*words.split(), f"out={tmp_path}", "executor=serial"])
    driven: list[object] = []

    class Watch:
        def __getattr__(self, name: str) -> Callable[..., None]:
            return lambda *given, **named: driven.append(name) if name == "finished" else None

    units = runner.run(config, Watch())  # type: ignore[arg-type]
    assert not driven, "the command drove again what score had driven"
    records = reading.read(tmp_path, units, track=track("driving"))
    assert sorted(found.records["seed"]) == sorted(records["seed"].to_pylist())
    attacked = found[found.role == "attacked"].iloc[0]
    rows = records.filter(records_are(records, "noise"))
    assert attacked.safe_progress == pytest.approx(sum(rows["safe_progress"].to_pylist()) / 2)
    assert attacked.low <= attacked.safe_progress <= attacked.high
    heading, *rows = repr(found).splitlines()
    assert heading.split() == ["role", "attack", "victim", "safe_progress", "low", "high", "crashed", "kept"]
    assert len(rows) == len(found)
    assert f"{found.safe_progress[0]:.2f}" in rows[0]


def records_are(records: Any, attack: str) -> Any:
    import pyarrow.compute as pc

    return pc.equal(records["attack"], attack)


def test_a_policy_object_drives_like_the_same_policy_by_name(score: Callable[..., Any]) -> None:
    by_name = score("dqn", "pgd", seeds=[0])
    policy = cavbench.load("dqn", seed=0)
    assert isinstance(policy, Policy)
    given = score(policy, cavbench.component("attack", "pgd"), name="mine")
    assert set(given.victim) == {"mine"}
    for column in ("safe_progress", "crashed", "queries"):
        torch.testing.assert_close(torch.tensor(given[column]), torch.tensor(by_name[column]), equal_nan=True)


def test_a_torch_network_is_scored_by_cell_and_found_again(
    score: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    network = Brakes().train()
    first = score(network, "noise", by="cell", weather=["clear", "fog"])
    assert list(first.weather) == ["clear", "fog", "clear", "fog"]
    assert network.training, "the caller's network was changed"
    monkeypatch.setattr("cavbench.driving.drive.rollout", None)
    assert score(network, "noise", by="cell", weather=["clear", "fog"]).equals(first)
    with pytest.raises(cavbench.UserError, match="TypeError"):
        score(Brakes(scale=2.0), "noise", weather=["clear", "fog"])


def test_a_network_of_controls_takes_flat_observations(score: Callable[..., Any]) -> None:
    found = score(Controls(), "noise")
    assert set(found.records["action_type"]) == {"continuous"}


def test_a_list_of_objects_holds_trainings(score: Callable[..., Any]) -> None:
    found = score([Brakes(scale=1.0), Brakes(scale=2.0)], "none")
    assert list(found.episodes) == [4]
    assert set(found.records["training_seed"]) == {0, 1}


def test_one_network_meets_every_training_of_an_attack_that_learns(score: Callable[..., Any]) -> None:
    found = score(Brakes(), "two_stage", seeds=[0, 1], baselines=False).records
    assert sorted(set(found["training_seed"][found["attack"] == "two_stage"])) == [0, 1]
    assert found["weights_sha256"].nunique() == 1


@pytest.mark.parametrize("algorithm", ["dqn", "ppo", "td3"])
def test_a_model_of_stable_baselines3_answers_like_predict(algorithm: str, score: Callable[..., Any]) -> None:
    model = sb3_model(algorithm, spaces(continuous=algorithm == "td3"))
    found = score(model, "pgd", record=0)
    assert "stable-baselines3" in found.records["libraries"][0]
    from cavbench.driving.victims.in_process import in_process

    observation = torch.rand(6, 10, 5) * 2 - 1
    policy = in_process([model], SHORT.facts, observation, None).policies[0]
    actions, _ = model.predict(observation.numpy(), deterministic=True)
    torch.testing.assert_close(policy.decide(observation), torch.as_tensor(actions))
    if algorithm == "td3":
        action = policy.decide(observation)
        value = model.critic(observation, action)[0].squeeze(-1)
        torch.testing.assert_close(policy.value(observation, action), value)


def test_an_attack_of_the_caller_is_driven_again_when_its_code_changes(score: Callable[..., Any]) -> None:
    found = score("dqn", [Still(), "noise"], seeds=[0])
    assert list(found.attack[:1]) == ["strongest of 2"]
    assert set(found.role) == {"strongest", "attacked", "clean"}
    attacked = found.safe_progress[found.role == "attacked"]
    assert attacked.min() <= found.safe_progress[0] <= attacked.max()
    changed = type("Still", (Still,), {"perturb": lambda self, observation, oracle: observation})
    changed.__qualname__, changed.__module__ = Still.__qualname__, Still.__module__
    again = score("dqn", dataclass(frozen=True, kw_only=True)(changed)(), seeds=[0])
    digests = {one[one.attack == "Still"]["code_digest"].iloc[0] for one in (found.records, again.records)}
    assert len(digests) == 2


@pytest.mark.parametrize(
    ("changed", "line"),
    [
        ({"victim": "dqnn"}, "unknown victim 'dqnn'; did you mean 'dqn'?"),
        ({"victim": 3}, "a victim is a name, a cavbench.driving.Policy, a torch.nn.Module or a model"),
        (
            {"victim": "dqn.zip"},
            r"unknown victim 'dqn.zip'; a file is given as victim=sb3 victim.path=dqn.zip \(from Python",
        ),
        ({"victim": "best.pt"}, "unknown victim 'best.pt'; such a file has weights without their network"),
        (
            {"victim": gymnasium.Env()},
            "An environment is no policy; as a world it is a subclass of cavbench.gym.GymWorld",
        ),
        ({"victim": nn.Linear(5, 5)}, r"Linear must map observations \[4, 10, 5\] or \[4, 50\]"),
        (
            {"victim": nn.Sequential(nn.Flatten(), nn.Linear(50, 4))},
            "returns 4 numbers for an observation; the world needs",
        ),
        ({"attack": "pdg"}, "did you mean 'pgd'"),
        ({"attack": Brakes()}, "attack takes a name or an object of a subclass of Attack, got Brakes"),
        ({"lanes": 99}, "lanes must be a whole number between 2 and 8, got 99"),
        ({"lane": 3}, "unknown argument or axis 'lane'; did you mean 'lanes'"),
        ({"threat": {"budget": -1}}, "threat.budget must be between 0 and 2"),
        ({"by": "row"}, "by must be 'pair' or 'cell'"),
        ({"name": "mine"}, "name= and actions= are for a victim that is an object"),
    ],
)
def test_what_is_not_allowed_is_one_line(changed: dict[str, Any], line: str, score: Callable[..., Any]) -> None:
    with pytest.raises(cavbench.UserError, match=line) as error:
        score(**{"victim": "dqn", "attack": "noise", **changed})
    assert "\n" not in str(error.value)


def test_objects_that_cannot_be_pickled_are_refused_by_workers(score: Callable[..., Any]) -> None:
    network = Brakes()
    network.hook = lambda value: value  # type: ignore[assignment]
    with pytest.raises(cavbench.UserError, match="cannot be sent to workers"):
        score(network, "noise", workers=2)


def test_load_adds_a_defence() -> None:
    plain, hardened = cavbench.load("dqn"), cavbench.load("dqn+advtrain", seed=1)
    own = choose("defense", "advtrain").component.load(choose("victim", "dqn").component, 1, SHORT.facts)
    assert plain.weights_sha256 != hardened.weights_sha256 == own.weights_sha256
    with pytest.raises(cavbench.UserError, match="unknown defense 'advtrian'; did you mean 'advtrain'"):
        cavbench.load("dqn+advtrian")


def test_importing_and_listing_load_no_torch() -> None:
    code = (
        "import sys, cavbench; dir(cavbench); sys.argv = ['bench', 'list']\n"
        "from cavbench.__main__ import main\n"
        "try: main()\n"
        "except SystemExit as end: assert not end.code\n"
        "heavy = {'torch', 'numba', 'pandas', 'gymnasium', 'rerun'} & set(sys.modules); assert not heavy, heavy"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stderr
    assert cavbench.score is cavbench.score


def test_what_makes_a_number_wrong_is_printed_below_it_and_is_data(tmp_path: Path) -> None:
    class Rounded(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layer = nn.Linear(50, 5)

        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            return torch.round(100 * self.layer(observation.flatten(1)))

    torch.manual_seed(0)
    where = {"lanes": 3, "density": 1, "weather": "clear", "episodes": 2, "out": tmp_path, "baselines": False}
    found = cavbench.score(Rounded(), "pgd", **where)
    assert "zero_gradients" in {one.name for one in found.remarks}
    assert "gradients are zero" in repr(found)
    assert "gradients are zero" in found._repr_html_()


def test_a_network_that_stands_twice_in_a_list_is_refused(tmp_path: Path) -> None:
    network = nn.Linear(50, 5)
    with pytest.raises(UserError, match="the victims 1 and 3 of the list are the same network"):
        cavbench.score([network, nn.Linear(50, 5), network], "noise", out=tmp_path)


class Looks(Policy):
    """Brakes where torch is as in a worker, and otherwise not."""

    action_type: ClassVar[ActionType] = "discrete"

    def scores(self, observation: Tensor, state: Any = None) -> Tensor:
        usual = numbers() == USUAL and not torch.is_inference_mode_enabled()
        return 0.01 * observation[..., 0, :] + float(usual) * torch.eye(5)[4].to(observation)


@pytest.mark.parametrize("mode", ["inference_mode", "autocast", "default", "precision"])
def test_it_computes_as_a_worker_does_whatever_the_caller_has_switched_on(mode: str, score: Callable[..., Any]) -> None:
    with CALLERS[mode]():
        records = score(Looks().eval(), PGD, episodes=1).records
    assert all(counts[4] == steps for counts, steps in zip(records["action_counts"], records["steps"], strict=True))
    assert records["zero_gradients"].dropna().tolist() == [0.0]
