"""PAAD: its director or the victim's own ranking decides, within small query budgets, and its recipe says what trains it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from cavbench import zoo
from cavbench.attacks.driving.paad import PAAD
from cavbench.attacks.driving.pgd import PGD
from cavbench.attacks.driving.sarsa import RobustSarsa
from cavbench.core.pair import Pair, choose
from cavbench.defenses.driving.advtrain import AdversarialTraining
from cavbench.defenses.none import NoDefense
from cavbench.driving import DrivingWorld, ObservationThreat
from cavbench.driving.access import Enforcer
from cavbench.driving.victim import CountedPolicy
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.networks import QPolicy
from cavbench.run.unit import Unit
from tests.attacks.driving.directors import Preferring
from tests.attacks.driving.victims import observations, perturb, victim


@pytest.fixture
def world() -> DrivingWorld:
    return choose("world", "highway").component


def test_paad_follows_the_victims_own_ranking_where_its_director_prefers_that() -> None:
    policy, seen = victim("discrete", 1), observations(40, 1)
    own = PAAD(steps=10, restarts=1).armed(Preferring(0, 0, 0, 0, 0, 1))
    lost, by_pgd, untouched = (
        policy.scores(seen).gather(-1, policy.decide(shown)[:, None]).mean()
        for shown in (perturb(own, policy, seen)[0], perturb(PGD(), policy, seen)[0], seen)
    )
    assert lost < untouched
    assert lost == pytest.approx(float(by_pgd), abs=0.1 * float(untouched - by_pgd))


def test_a_recipe_names_the_attack_the_victim_and_the_defence_with_their_parameters() -> None:
    base = zoo.Recipe.of(DQN(), NoDefense(), PAAD())
    assert base.name == "paad-dqn"
    assert base.train(3) == "bench train victim=dqn attack=paad seeds=3"
    others = [
        zoo.Recipe.of(DQN(hidden=64), NoDefense(), PAAD()),
        zoo.Recipe.of(DQN(), AdversarialTraining(), PAAD()),
        zoo.Recipe.of(DQN(), AdversarialTraining(skip=0.5), PAAD()),
        zoo.Recipe.of(DQN(), NoDefense(), PAAD(budget=0.2)),
        zoo.Recipe.of(DQN(), NoDefense(), RobustSarsa()),
    ]
    assert len({base.digest, *(other.digest for other in others)}) == 6
    assert others[2].train(0) == "bench train victim=dqn defense=advtrain attack=paad defense.skip=0.5 seeds=0"


def test_parameters_of_the_run_need_no_other_training() -> None:
    base = zoo.Recipe.of(DQN(), NoDefense(), PAAD())
    assert zoo.Recipe.of(DQN(), NoDefense(), PAAD(steps=30, restarts=1)).digest == base.digest


def test_another_adversary_is_another_unit_of_work(world: DrivingWorld) -> None:
    parts = {
        "attack": choose("attack", "paad"),
        "defense": choose("defense", "none"),
        "victim": choose("victim", "dqn"),
    }
    pair = Pair(**parts, world=choose("world", "highway"), threat=ObservationThreat())
    cell = world.axes.cell(lanes=3, density=1.0, weather="clear")
    unit = Unit(pair=pair, cell=cell, training_seed=0, seeds=range(2), weights_sha256="w", adversary_sha256="a")
    assert unit.fingerprint != replace(unit, adversary_sha256="b").fingerprint
    assert pair.is_seeded


def test_directed_attacks_keep_to_small_query_budgets() -> None:
    policy, seen = victim("discrete"), observations(8)
    director = QPolicy(5, 6, 8).requires_grad_(False)
    for queries in (0, 1, 2, 3, 9, 40):
        threat = ObservationThreat(queries=queries)
        shown, spent = perturb(PAAD().armed(director), policy, seen, threat)
        assert int(spent.max()) <= queries
        features = choose("world", "highway").component.features
        enforcer = Enforcer(CountedPolicy(policy), threat, "oblivious", features, torch.Generator())
        torch.testing.assert_close(enforcer.begin(seen).project(shown), shown)
