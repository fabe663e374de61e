"""Attacks with a network of their own: how they are trained, and how the zoo keeps them."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import pytest
import torch

from cavbench import zoo
from cavbench.checks.check import Subject
from cavbench.core.pair import choose
from cavbench.defenses.driving.advtrain import AdversarialTraining
from cavbench.defenses.none import NoDefense
from cavbench.driving import DrivingAttack, DrivingWorld
from cavbench.driving.checks.attack import AttackSuite
from cavbench.driving.victims.dqn import DQN
from cavbench.errors import UserError
from tests.attacks.driving.directors import LEARNED, NAMES, silent, trained
from tests.attacks.driving.victims import observations, perturb
from tests.tree import ROOT


@pytest.fixture
def world() -> DrivingWorld:
    return choose("world", "highway").component


@pytest.fixture(autouse=True)
def own_zoo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    return tmp_path / "zoo"


@pytest.mark.parametrize("attack", LEARNED, ids=NAMES)
def test_a_training_depends_on_its_seed_only_and_leaves_the_victim_alone(
    attack: DrivingAttack, world: DrivingWorld
) -> None:
    before = DQN().load(0, world.facts).state_dict()
    first, again, other = (trained(attack, world, seed).network.state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)
    after = DQN().load(0, world.facts).state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_the_card_says_what_was_attacked_and_what_was_left_of_it(world: DrivingWorld) -> None:
    card = trained(LEARNED[1], world).card
    assert card["against"] == DQN().load(0, world.facts).weights_sha256
    assert 0 <= card["selection"]["safe_progress"]["clean"]["mean"] <= 1


@pytest.mark.parametrize("attack", LEARNED, ids=NAMES)
def test_the_zoo_keeps_an_adversary_and_says_how_to_train_a_missing_one(
    attack: DrivingAttack, world: DrivingWorld, own_zoo: Path
) -> None:
    recipe = zoo.Recipe.of(DQN(), NoDefense(), attack)
    with pytest.raises(UserError, match=r"`bench train victim=dqn attack=.* seeds=0`"):
        attack.load(DQN(), NoDefense(), 0, world.facts)
    made = trained(attack, world)
    zoo.save(made.network, recipe, seed=0, world=world, card=made.card)
    loaded = attack.load(DQN(), NoDefense(), 0, world.facts)
    weights = made.network.state_dict()
    assert all(torch.equal(weights[name], value) for name, value in loaded.state_dict().items())
    assert not loaded.training
    assert not any(weight.requires_grad for weight in loaded.parameters())
    seen = observations(6, rows=10)
    policy = DQN().load(0, world.facts)
    assert torch.equal(
        perturb(attack.armed(loaded), policy, seen)[0], perturb(attack.armed(made.network), policy, seen)[0]
    )


def test_an_adversary_of_other_weights_is_refused(world: DrivingWorld, own_zoo: Path) -> None:
    attack = LEARNED[1]
    made = trained(attack, world)
    recipe = zoo.Recipe.of(DQN(), NoDefense(), attack)
    zoo.save(made.network, recipe, seed=0, world=world, card={**made.card, "against": "0" * 64})
    with pytest.raises(UserError, match="was trained against a victim with weights 000000000000…, and the victim has"):
        attack.load(DQN(), NoDefense(), 0, world.facts)


def test_adversarial_training_refuses_an_attack_that_learns(world: DrivingWorld) -> None:
    with pytest.raises(UserError, match="takes attacks that do not learn"):
        AdversarialTraining(attack="paad", attack_params="").train(DQN(), world, seed=0, progress=silent)


def test_the_attack_that_learns_on_the_page_of_plug_ins_works(world: DrivingWorld, tmp_path: Path) -> None:
    page = (ROOT / "docs" / "plugins.md").read_text()
    (code,) = re.findall(r"```python\n(\"\"\"Universal:.*?)```", page, re.DOTALL)
    (tmp_path / "universal.py").write_text(code)
    spec = importlib.util.spec_from_file_location("universal", tmp_path / "universal.py")
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["universal"] = module
    try:
        spec.loader.exec_module(module)
        attack = module.Universal(candidates=20)
        made = trained(attack, world)
        recipe = zoo.Recipe.of(DQN(), NoDefense(), attack)
        zoo.save(made.network, recipe, seed=0, world=world, card=made.card)
        armed = attack.armed(attack.load(DQN(), NoDefense(), 0, world.facts))
        subject = Subject(kind="attack", name="universal", component=armed, world=world, victim=DQN())
        assert [one for one in AttackSuite(subject).outcomes() if one.status != "pass"] == []
    finally:
        del sys.modules["universal"]
