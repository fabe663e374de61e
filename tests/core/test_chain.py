"""A chain of defences is a word of its own: on the command line, in records, and behind `bench list`."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
import torch
from rich.console import Console

from cavbench.cli.listing import print_component
from cavbench.cli.train import train
from cavbench.core.options import configured
from cavbench.core.pair import choose
from cavbench.defenses.driving.shield import Shielded
from cavbench.defenses.driving.tracker import Tracked
from cavbench.driving.drive import drive
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.networks import QPolicy
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from cavbench.records import reading
from cavbench.run.config import plan_of, training_of
from cavbench.run.replay import find, replay
from cavbench.run.runner import run
from tests.run.test_runner import Silent

FACTS = HighwayWorld().facts
WORDS = (
    "victim=dqn",
    "attack=none",
    "lanes=3",
    "density=1",
    "weather=clear",
    "seeds=0",
    "episodes=2",
    "reference=false",
)


def test_the_observation_passes_the_links_in_their_order() -> None:
    chain = choose("defense", "tracker+shield").component
    policy = chain.load(choose("victim", "dqn").component, 0, FACTS)
    assert isinstance(policy, Tracked)
    assert isinstance(policy.policy, Shielded)
    assert isinstance(policy.policy.policy, QPolicy)


def test_a_trained_victim_stands_behind_the_filters() -> None:
    victim = choose("victim", "dqn").component
    trained = choose("defense", "advtrain").component.load(victim, 0, FACTS)
    policy = choose("defense", "advtrain+shield").component.load(victim, 0, FACTS)
    assert isinstance(policy, Shielded)
    assert policy.policy.weights_sha256 == policy.weights_sha256 == trained.weights_sha256
    assert choose("defense", "advtrain+shield").component.seeded
    assert not choose("defense", "tracker+shield").component.seeded


def test_each_link_has_its_own_parameters() -> None:
    chosen = configured("defense", "tracker+shield", {"shield.band": "4", "tracker.assumed_norm": "linf"})
    assert str(chosen) == "tracker+shield(tracker.assumed_norm=linf, shield.band=4.0)"
    assert chosen.component.shield.band == 4.0
    assert chosen.component.shield.assumed_norm == "relative"


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("tracker+shield", {"shield.bnd": "4"}, "did you mean 'shield.band'"),
        ("tracker+shield", {"shield.band": "-1"}, "band must be at least 0"),
        ("tracker+shield", {"shield.assumed_norm": "l2"}, "linf"),
        ("shield+shield", {}, "each defence once"),
        ("shield+advtrain", {}, "must come first"),
        ("masking+advtrain_detection", {}, "must come first"),
        ("tracker+nosuch", {}, "nosuch"),
        ("tracker+jpeg", {}, "different tracks"),
        ("guard+frame_stack", {}, "'guard' needs digits, but links have defaults"),
    ],
)
@pytest.mark.usefixtures("toy_folder")
def test_bad_chains_are_refused_in_one_line(name: str, values: dict[str, str], said: str) -> None:
    with pytest.raises(UserError, match=said) as refused:
        configured("defense", name, values)
    assert "\n" not in str(refused.value)


def test_a_chain_is_listed_with_the_parameters_of_its_links() -> None:
    console = Console(width=200, record=True)
    print_component("tracker+shield", console)
    text = console.export_text()
    assert "cavbench.defenses.driving.tracker:Tracker + cavbench.defenses.driving.shield:Shield" in text
    assert "defense.shield.band" in text


def test_a_chain_is_recorded_and_replayed_and_its_code_counts(tmp_path: Path) -> None:
    config = plan_of([*WORDS, "defense=tracker+shield", "workers=1", f"out={tmp_path}"])
    (unit,) = config.units()
    assert {"cavbench.defenses.driving.shield", "cavbench.defenses.driving.tracker"} <= set(unit.modules)
    run(config, Silent())
    (records,) = reading.read_all(tmp_path).values()
    assert set(records["defense"].to_pylist()) == {"tracker+shield"}
    assert all(share > 0.5 for share in records["assured"].to_pylist())
    again = replay(tmp_path, find(records, {"attack": "none"}))
    assert (again.differences, again.changed) == ((), "")
    for params in ('{"tracker": {"nosuch": 1}, "shield": {}}', '{"nosuch": {}}', '{"tracker": {"assumed_budget": {}}}'):
        with pytest.raises(UserError) as refused:
            replay(tmp_path, find(records, {"attack": "none"}) | {"defense_params": params})
        assert "\n" not in str(refused.value)
    other = plan_of([*WORDS, "defense=tracker+shield", "defense.shield.band=5", f"out={tmp_path}"])
    assert other.units()[0].fingerprint != unit.fingerprint


def test_a_policy_that_promises_nothing_has_no_share_of_assured_frames() -> None:
    assert choose("victim", "dqn").component.load(0, FACTS).assured(torch.zeros(1, 10, 5), None) is None


SMALL = ("decisions=16", "copies=1", "hidden=8", "batch=16", "memory=2000", "checkpoints=1")
SHORT = ["world.max_steps=20", *(f"victim.{word}" for word in SMALL)]


def test_a_driver_is_trained_behind_a_chain_and_drives_behind_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`bench train defense=CHAIN` says which command uses the result; its weights are another driver's."""
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    monkeypatch.setattr(DQN, "selection_episodes", 3)
    parameters = ["victim.behind_decisions=48", "defense.shield.band=3", "defense.tracker.assumed_budget=0.08"]

    def trained(*words: str) -> list[str]:
        console = Console(width=400, record=True)
        train(training_of(["victim=dqn", *SHORT, *words]), console)
        return shlex.split(console.export_text().partition("To use it: ")[2])[2:]

    plain, world = trained(), "victim.trained_in=max_steps=20"
    behind = trained("defense=tracker+shield", *parameters)
    hardened = trained("defense=advtrain+tracker+shield", "defense.advtrain.decisions=48", world, *parameters)
    units = [plan_of([*WORDS[1:], *used]).units()[0] for used in (plain, behind, hardened)]
    assert len({unit.weights_sha256 for unit in units}) == 3
    assert 'victim.behind="tracker+shield tracker.assumed_budget=0.08 shield.band=3.0"' in behind
    assert {"defense=advtrain+tracker+shield", "defense.shield.band=3.0"} <= set(hardened)
    columns = drive(units[1].job, ()).columns
    assert (columns["assured"] >= 0).all()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["defense=frame_stack"], "does not say what it passes on"),
        (["victim.behind=shield", "defense=tracker+shield"], "leave it out"),
        (["victim.behind=advtrain"], "trains its victim"),
        (["victim.behind=nosuch"], "nosuch"),
        (["victim.behind=jpeg"], "another track"),
    ],
)
def test_what_nobody_can_be_trained_behind_is_refused_in_one_line(words: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=said) as refused:
        train(training_of(["victim=dqn", *words, f"out={tmp_path}"]), Console(quiet=True))
    assert "\n" not in str(refused.value)
