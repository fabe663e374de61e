"""PGD: its first step is FGSM, more steps are never weaker, it is never worse than its start points, and it beats noise."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cavbench.attacks.driving.candidates import random_starts
from cavbench.attacks.driving.noise import Noise
from cavbench.attacks.driving.objectives import Objective
from cavbench.attacks.driving.pgd import PGD
from cavbench.driving import ActionType, ObservationThreat
from cavbench.driving.threat import project
from tests.attacks.driving.victims import FEATURES, Linear, left, loss_of, observations, open_oracle, perturb, victim

OBJECTIVES: tuple[Objective, ...] = ("collision", "expected", "margin", "target")


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 999), st.sampled_from(OBJECTIVES))
def test_one_whole_step_from_the_truth_is_fgsm_where_that_is_better_than_the_truth(
    seed: int, objective: Objective
) -> None:
    threat, policy, observation = ObservationThreat(budget=0.1), victim("discrete", seed), observations(8, seed)
    leaf = observation.clone().requires_grad_(True)
    loss_of(policy, objective, observation)(policy.scores(leaf)).sum().backward()
    assert leaf.grad is not None
    radius = threat.radius(observation, FEATURES)
    fgsm = project(observation - radius * leaf.grad.sign(), observation, radius)
    attack = PGD(steps=1, step_size=1.0, restarts=1, random_start=False, objective=objective)
    shown, _ = perturb(attack, policy, observation, threat)
    loss = loss_of(policy, objective, observation)
    before, after = (loss.key(scores, loss(scores)) for scores in map(policy.scores, (observation, fgsm)))
    assert torch.equal(shown, torch.where((after < before)[:, None, None], fgsm, observation))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 999), st.sampled_from(OBJECTIVES))
def test_it_is_never_worse_than_the_truth_and_its_random_starts(seed: int, objective: Objective) -> None:
    policy, observation = victim("discrete", seed), observations(8, seed)
    attack = PGD(steps=1, step_size=2.0, restarts=3, objective=objective)
    oracle = open_oracle(policy, attack, observation)
    starts = random_starts(observation, 3, oracle)
    loss = loss_of(policy, objective, observation)
    scores = policy.scores(torch.cat((observation[None], starts)))
    assert (left(attack, policy, observation, objective) <= loss.key(scores, loss(scores)).amin(0) + 1e-6).all()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 99), st.booleans())
def test_pgd_finds_the_optimum_of_a_linear_victim(seed: int, random_start: bool) -> None:
    policy, observation = Linear(seed), observations(8, seed)
    attack = PGD(steps=5, step_size=1.0, restarts=1, objective="margin", random_start=random_start)
    shown, _ = perturb(attack, policy, observation)
    action = policy.decide(observation)
    slope = policy.layer.weight[action] - policy.layer.weight[1 - action]
    radius = ObservationThreat(budget=0.2).radius(observation, FEATURES)
    optimum = project(observation - radius * slope.view_as(observation).sign(), observation, radius)
    torch.testing.assert_close(shown, optimum)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_pgd_beats_noise_on_its_objective(objective: Objective) -> None:
    policy, observation = victim("discrete"), observations(300)
    attacks = (PGD(objective=objective), Noise(), None)
    attacked, noisy, clean = (left(attack, policy, observation, objective) for attack in attacks)
    assert float((attacked <= noisy).float().mean()) > 0.95
    assert float((clean - attacked).mean()) > 2 * float((clean - noisy).mean())


@pytest.mark.parametrize(
    ("weak", "strong"),
    [(PGD(restarts=1, steps=1), PGD(restarts=1, steps=10)), (PGD(restarts=1, steps=5), PGD(restarts=8, steps=5))],
    ids=["steps", "restarts"],
)
def test_more_work_makes_a_stronger_attack(weak: PGD, strong: PGD) -> None:
    policy, observation = victim("discrete"), observations(300)
    assert float(left(strong, policy, observation).mean()) < float(left(weak, policy, observation).mean())


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 5), st.integers(1, 4), st.sampled_from(("discrete", "continuous")))
def test_queries_are_one_clean_and_one_per_iterate(steps: int, restarts: int, action_type: ActionType) -> None:
    _, spent = perturb(PGD(steps=steps, restarts=restarts), victim(action_type), observations(3))
    price = 1 if action_type == "discrete" else 2  # the loss of a continuous victim asks its critic
    assert spent.tolist() == [price * (1 + restarts * (steps + 1))] * 3


@pytest.mark.parametrize("queries", [0, 1, 2])
def test_without_queries_for_a_step_it_returns_the_true_observation(queries: int) -> None:
    observation = observations(4)
    shown, _ = perturb(PGD(), victim("discrete"), observation, ObservationThreat(queries=queries))
    assert torch.equal(shown, observation)


def test_collision_never_prefers_braking() -> None:
    policy, observation = victim("discrete"), observations(400)
    brakes = {
        objective: float((policy.decide(perturb(PGD(objective=objective), policy, observation)[0]) == 4).float().mean())
        for objective in ("collision", "expected")
    }
    assert brakes["collision"] < brakes["expected"]


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_a_continuous_victim_moves_towards_the_objective(objective: Objective) -> None:
    policy, observation = victim("continuous"), observations(200)
    shown, _ = perturb(PGD(objective=objective), policy, observation)
    before, after = policy.decide(observation), policy.decide(shown)
    if objective == "margin":
        assert float((after - before).norm(dim=-1).mean()) > 0.1
    elif objective == "target":
        target = torch.tensor([1.0, 0.5])
        assert float((after - target).norm(dim=-1).mean()) < float((before - target).norm(dim=-1).mean())
    else:
        assert float(policy.value(observation, after).mean()) < float(policy.value(observation, before).mean())
