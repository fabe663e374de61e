"""Adversarial training: which decisions are attacked, by what, and what its losses do."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from cavbench import zoo
from cavbench.core import registry
from cavbench.defenses.driving.advtrain import AdversarialTraining, AttackInLoop
from cavbench.driving import DrivingWorld
from cavbench.driving.victims.networks import QPolicy
from cavbench.driving.victims.training import LearningDriver
from cavbench.errors import UserError
from tests.driving.victims.learners import LEARNERS, NAMES, VICTIMS, Lesson, silent


@pytest.fixture
def world() -> DrivingWorld:
    return registry.load("world", "highway")()


@pytest.mark.parametrize("skip", [0.0, 0.5, 1.0])
def test_the_skip_probability_sets_the_rate_of_attacks(skip: float, world: DrivingWorld) -> None:
    defense = AdversarialTraining(
        start="scratch", where="acting", skip=skip, ramp_to=0.0, attack="noise", attack_params=""
    )
    card = defense.train(VICTIMS[0], world, seed=0, progress=silent).card
    assert card["attacked_decisions"] / (160 * 6) == pytest.approx(1 - skip, abs=0.06)


def test_the_budget_follows_the_ramp() -> None:
    defense = AdversarialTraining(skip=0.0, attack="noise", attack_params="", ramp_from=0.2, ramp_to=0.6)
    world = registry.load("world", "highway")()
    loop = AttackInLoop(defense, [registry.load("attack", "noise")()], world.facts, None, seed=0)
    policy, seen = QPolicy(5, 5, 8), 0.5 * torch.ones(16, 10, 5)
    moved = [float((loop.shown(seen, policy, share) - seen).abs().max()) for share in (0.1, 0.3, 0.4, 0.6, 0.9)]
    assert moved == pytest.approx([0.0, moved[4] / 4, moved[4] / 2, moved[4], moved[4]], rel=0.01)
    assert moved[4] > 0


def test_each_attack_of_the_loop_is_drawn_and_selects(world: DrivingWorld) -> None:
    defense = AdversarialTraining(skip=0.0, ramp_to=0.0)
    attacks = [registry.load("attack", "noise")(scale=scale) for scale in (0.01, 1.0)]
    loop = AttackInLoop(defense, attacks, world.facts, None, seed=0)
    policy, seen = QPolicy(5, 5, 8), 0.5 * torch.ones(2, 10, 5)
    strong = [bool((loop.shown(seen, policy, 0.5) - seen).abs().max() > 0.02) for _ in range(40)]
    assert 10 < sum(strong) < 30
    scored = {name: float((show(seen, None) - seen).abs().max()) for name, show in loop.selection(policy).items()}
    assert [moved > 0.02 for moved in scored.values()] == [False, True]
    assert loop.ranked({"clean": 0.8, **dict(zip(scored, (0.6, 0.2), strict=True))}) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("others", "wrong"),
    [("zo, nothing", "'nothing'"), ("zo, plan", "'plan' is not one"), ("zo steps", "'steps'")],
)
def test_an_attack_that_cannot_be_in_the_loop_is_refused(others: str, wrong: str, world: DrivingWorld) -> None:
    with pytest.raises(UserError, match=wrong):
        AdversarialTraining(others=others).train(VICTIMS[0], world, seed=0, progress=silent)


@pytest.mark.parametrize("victim", VICTIMS, ids=["dqn", "ddpg"])
def test_consistency_moves_decisions_under_attack_towards_clean_decisions(
    victim: LearningDriver, world: DrivingWorld
) -> None:
    lesson = Lesson(victim, world)
    wanted = lesson.decision(lesson.teacher.scores(lesson.truth))
    far, near = ((lesson.decided(consistency=weight) - wanted).square().mean() for weight in (0.0, 10.0))
    assert float(near) < 0.7 * float(far)


def test_a_margin_makes_lane_changes_less_likely(world: DrivingWorld) -> None:
    lesson = Lesson(VICTIMS[0], world)
    spread = float(lesson.teacher.scores(lesson.truth).std(-1).mean())
    without, reluctant = (lesson.decided(consistency=10.0, margin=margin).mean(0) for margin in (0.0, spread))
    assert bool((reluctant[[0, 2]] < 0.7 * without[[0, 2]]).all())


@pytest.mark.parametrize("victim", LEARNERS, ids=NAMES)
@pytest.mark.parametrize("start", ["trained", "scratch"])
def test_adversarial_training_trains_saves_and_loads(
    victim: LearningDriver, start: str, world: DrivingWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    trained = victim.train(world, seed=0, progress=silent)
    zoo.save(trained.network, zoo.Recipe.of(victim), seed=0, world=world, card=trained.card)
    defense = AdversarialTraining(start=start, decisions=160, attack="zo", attack_params="steps=1 directions=2")
    hardened = defense.train(victim, world, seed=0, progress=silent)
    assert hardened.card["attacked_decisions"] > 0
    zoo.save(hardened.network, zoo.Recipe.of(victim, defense), seed=0, world=world, card=hardened.card)
    loaded = defense.load(victim, 0, world.facts)
    x = torch.rand(4, 10, 5)
    torch.testing.assert_close(loaded.scores(x), hardened.network.scores(x))
    assert not torch.equal(loaded.scores(x), victim.load(0, world.facts).scores(x))
