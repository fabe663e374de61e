"""Rival: trained against a victim, kept in the zoo, driven within the bounds, and worse for the victim than an untrained one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from cavbench import zoo
from cavbench.attacks.driving.rival import Rival
from cavbench.attacks.driving.rival_seat import ACTIONS, FEATURES
from cavbench.core.pair import choose
from cavbench.core.track import Columns, track
from cavbench.defenses.none import NoDefense
from cavbench.driving import Control, DrivingWorld, ObservationThreat, Policy
from cavbench.driving.rollout import Trace, rollout
from cavbench.driving.sets import Traffic
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.networks import QPolicy
from cavbench.envs.highway.axes import AXES
from cavbench.errors import UserError
from cavbench.records import reading
from cavbench.run.replay import replay
from cavbench.scenarios import SeedBlock
from tests.attacks.driving.directors import silent
from tests.attacks.driving.test_trained_attacks import RUN
from tests.cli.test_cli import assert_one_line
from tests.command import Bench

SHORT = Rival(decisions=64, copies=1, rollout=8, hidden=8)
OPTIONS = ("attack.decisions=64", "attack.copies=1", "attack.rollout=8", "attack.hidden=8")
ROADS = ((3, 2.0), (5, 1.0))


class Chance(Policy):
    """Chooses at random."""

    action_type = "discrete"

    def forward(self, observation: Tensor) -> Tensor:
        return torch.rand(*observation.shape[:-2], ACTIONS)


@pytest.fixture
def world() -> DrivingWorld:
    return choose("world", "highway").component


def driven(
    world: DrivingWorld, network: Policy, cars: int = 1, scenarios: int = 20, trace: Trace | None = None
) -> Columns:
    """What `dqn` does among cars that the network drives, on scenarios that no training uses."""
    cells = [AXES.cell(lanes=lanes, density=density) for lanes, density in ROADS for _ in range(scenarios)]
    seeds = [SeedBlock.TUNE + number for _ in ROADS for number in range(scenarios)]
    bounds = Traffic(cars=cars)
    return rollout(
        world.build(cells, Control(traffic=bounds)),
        DQN().load(0, world.facts),
        SHORT.armed(network.eval()),
        ObservationThreat(budget=0.0, access="decisions", traffic=bounds),
        seeds,
        facts=world.facts,
        attack_seed=0,
        trace=trace,
    )


@pytest.mark.slow
def test_a_training_of_some_seconds_beats_untrained_policies_and_chance(world: DrivingWorld) -> None:
    recipe = Rival(decisions=120_000, hidden=32, copies=20, learning_rate=2e-3)
    trained = recipe.train(DQN(), NoDefense(), world, seed=0, progress=silent).network
    torch.manual_seed(1)
    # One untrained policy may happen to brake in front of everybody.
    networks = [trained, Chance(), *(QPolicy(FEATURES, ACTIONS, 32) for _ in range(3))]
    ours, chance, *untrained = (driven(world, network, scenarios=30)["crashed"].mean() for network in networks)
    assert ours > chance + 0.2
    assert ours > np.mean(untrained) + 0.1


def test_a_training_depends_on_its_seed_only_and_leaves_the_victim_alone(world: DrivingWorld) -> None:
    before = DQN().load(0, world.facts).state_dict()
    first, again, other = (
        SHORT.train(DQN(), NoDefense(), world, seed=seed, progress=silent).network.state_dict() for seed in (0, 0, 1)
    )
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)
    after = DQN().load(0, world.facts).state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_the_cars_of_a_run_are_those_that_the_threat_model_allows(world: DrivingWorld) -> None:
    torch.manual_seed(0)
    network = QPolicy(FEATURES, ACTIONS, 8)
    one, three = (driven(world, network, cars, scenarios=4) for cars in (1, 3))
    assert set(one) == set(three)
    assert not np.array_equal(one["safe_progress"], three["safe_progress"])
    assert (one["queries"] == 0).all()


def test_a_rival_of_another_victim_is_refused(
    world: DrivingWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    made = SHORT.train(DQN(), NoDefense(), world, seed=0, progress=silent)
    recipe = zoo.Recipe.of(DQN(), NoDefense(), SHORT)
    with pytest.raises(UserError, match=r"`bench train victim=dqn attack=rival .* seeds=0`"):
        SHORT.load(DQN(), NoDefense(), 0, world.facts)
    zoo.save(made.network, recipe, seed=0, world=world, card={**made.card, "against": "0" * 64})
    with pytest.raises(UserError, match="was trained against a victim with weights 000000000000…, and the victim has"):
        SHORT.load(DQN(), NoDefense(), 0, world.facts)


@pytest.mark.slow
def test_it_is_trained_then_run_then_replayed(bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    both = ("attack=rival", *OPTIONS, "victim=dqn")
    run = ("run", *both, *RUN, "world.max_steps=60", f"out={tmp_path / 'results'}")
    assert_one_line(bench(*run, "threat.traffic.cars=1"), "the zoo has no 'rival-dqn' with", "victim=dqn attack=rival")
    said = bench("train", *both, "seeds=0")
    assert said.code == 0
    assert "To use it: bench run victim=dqn attack=rival" in said.out
    assert "threat.traffic.cars=1" in said.out
    nobody = bench(*run)
    assert nobody.code != 0
    assert "can do nothing under this threat model: allow it threat.traffic.cars=1" in nobody.err
    assert bench(*run, "threat.traffic.cars=1").code == 0
    records = reading.read(tmp_path / "results", track=track("driving"))
    attacked = [row for row in records.to_pylist() if row["attack"] == "rival"]
    assert len(attacked) == 2
    assert {row["queries"] for row in attacked} == {0.0}
    again = replay(tmp_path / "results", attacked[0])
    assert (again.changed, again.differences) == ("", ())


def test_bad_trainings_are_refused_in_one_line(bench: Bench) -> None:
    train = ("train", "attack=rival")
    assert_one_line(bench(*train, "victim=blind"), "does not fit victim 'blind'", "ignores its input")
    assert_one_line(bench(*train, "attack.cars=0"), "cars must be")
    assert_one_line(bench(*train, "attack.clip=1"), "clip must be")
    assert_one_line(bench(*train, "world=recorded"), "it drives cars of the traffic, which this world does not allow")
