"""Attacks of the Adversarial Robustness Toolbox: inside the threat model, with counted queries, repeatable, and effective."""

from __future__ import annotations

import random
import sys

import numpy as np
import pytest
import torch

from cavbench.attacks.driving.art import ATTACKS, _component
from cavbench.attacks.driving.noise import Noise
from cavbench.attacks.driving.pgd import PGD
from cavbench.core.pair import choose
from cavbench.driving import DrivingAttack, ObservationThreat
from cavbench.errors import UserError
from tests.attacks.driving.victims import FEATURES, Linear, observations, perturb, victim
from tests.checks.rules import broken

THREAT = ObservationThreat(norm="linf", budget=0.4, queries=60)


def art(choice: str, **params: object) -> DrivingAttack:
    pytest.importorskip("art")
    attack = choose("attack", f"art:{choice}", **params).component
    assert isinstance(attack, DrivingAttack)
    return attack


@pytest.mark.slow
@pytest.mark.parametrize("choice", ATTACKS)
def test_every_attack_is_inside_the_set_within_its_queries_and_repeatable(choice: str) -> None:
    attack, policy, observation = art(choice), victim("discrete"), observations(8)
    shown, spent = perturb(attack, policy, observation, THREAT)
    np.random.seed(1)  # noqa: NPY002
    again, _ = perturb(attack, policy, observation, THREAT)
    assert torch.equal(shown, again)
    assert 1 < int(spent.max()) <= 60
    assert bool(((shown - observation).abs() <= THREAT.radius(observation, FEATURES) + 1e-6).all())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("choice", "values"),
    [
        ("SquareAttack", {"max_iter": "20"}),
        ("HopSkipJump", {"init_size": "20"}),
        ("ProjectedGradientDescent", {"max_iter": "10", "num_random_init": "2"}),
        ("AutoProjectedGradientDescent", {"max_iter": "5", "nb_random_init": "2"}),
    ],
)
def test_attacks_of_every_access_keep_the_rules(choice: str, values: dict[str, str]) -> None:
    pytest.importorskip("art")
    assert broken("attack", f"art:{choice}", **values) == {}


def test_the_box_of_art_is_the_perturbation_set() -> None:
    """One full step of ART's FGSM and one of `pgd` end at the same point: the corner of the set."""
    policy, observation = Linear(0), observations(40)
    threat = ObservationThreat(norm="relative", budget=0.1)
    own = PGD(steps=1, step_size=1.0, restarts=1, random_start=False, objective="margin")
    ours, _ = perturb(own, policy, observation, threat)
    shown, spent = perturb(art("FastGradientMethod"), policy, observation, threat)
    changed = policy.decide(shown) != policy.decide(observation)
    assert torch.equal(changed, policy.decide(ours) != policy.decide(observation))
    assert bool(changed.any())
    torch.testing.assert_close(shown[changed], ours[changed])
    assert spent.unique().tolist() == [3]


def test_known_answers_cost_no_queries() -> None:
    """ART's SquareAttack queries each point three times; with the cache an iteration costs one query, as in its paper."""
    policy, observation = victim("discrete"), observations(30)
    threat = ObservationThreat(budget=0.001)
    _, spent = perturb(art("SquareAttack", max_iter=20), policy, observation, threat)
    assert int(spent.max()) <= 1 + 1 + 20


@pytest.mark.parametrize("choice", ["SquareAttack", "HopSkipJump", "ProjectedGradientDescent"])
def test_it_changes_more_decisions_than_noise_and_then_stops(choice: str) -> None:
    policy, observation = victim("discrete"), observations(40)
    shown, spent = perturb(art(choice), policy, observation, THREAT)
    noisy, _ = perturb(Noise(), policy, observation, THREAT)
    clean = policy.decide(observation)
    changed = policy.decide(shown) != clean
    assert int(changed.sum()) > int((policy.decide(noisy) != clean).sum())
    assert float(spent[changed].double().mean()) < 60


def test_a_targeted_attack_reaches_its_target() -> None:
    policy, observation = victim("discrete"), observations(40)
    shown, spent = perturb(art("ProjectedGradientDescent", target=3, max_iter=10), policy, observation, THREAT)
    already, after = policy.decide(observation) == 3, policy.decide(shown) == 3
    assert int(after.sum()) > int(already.sum())
    assert bool((spent[already] == 1).all())
    with pytest.raises(ValueError, match="5 actions, got 9"):
        perturb(art("ProjectedGradientDescent", target=9), policy, observation)


def test_an_episode_with_one_query_is_not_perturbed() -> None:
    observation = observations(3)
    shown, spent = perturb(art("SquareAttack"), victim("discrete"), observation, ObservationThreat(queries=1))
    assert torch.equal(shown, observation)
    assert spent.tolist() == [1, 1, 1]


@pytest.mark.parametrize("choice", ["SquareAttack", "BoundaryAttack"])
def test_global_random_generators_are_restored(choice: str) -> None:
    attack, made = art(choice), np.random.RandomState
    np.random.seed(7)  # noqa: NPY002
    random.seed(7)
    perturb(attack, victim("discrete"), observations(3), THREAT)
    drawn = (np.random.rand(), random.random())  # noqa: NPY002
    np.random.seed(7)  # noqa: NPY002
    random.seed(7)
    assert drawn == (np.random.rand(), random.random())  # noqa: NPY002
    assert np.random.RandomState is made


def test_a_bad_argument_is_refused_with_arts_message() -> None:
    with pytest.raises(UserError, match=r"attack 'art:SquareAttack': .*p_init .* in range \[0, 1\]"):
        art("SquareAttack", p_init=3.0)


def test_without_the_toolbox_the_error_has_the_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "art.attacks", None)
    _component.cache_clear()
    with pytest.raises(UserError, match=r"needs the Adversarial Robustness Toolbox: pip install 'cavbench\[art\]'"):
        choose("attack", "art:SquareAttack")
