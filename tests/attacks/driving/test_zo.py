"""ZO-SignSGD: its query count is exact, its early stop saves queries, and its estimate points down the gradient."""

from __future__ import annotations

from dataclasses import replace
from itertools import accumulate, pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.attacks.driving.noise import Noise
from cavbench.attacks.driving.objectives import Objective, distortion
from cavbench.attacks.driving.zo import ZOObjective, ZOSignSGD, _directions, _gradient
from cavbench.driving import ActionType, ObservationThreat, Part, Policy
from tests.attacks.driving.victims import Linear, left, loss_of, observations, perturb, victim


class Counting(Policy):
    """The real victim, with a log of what it was asked."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.action_type, self.policy = policy.action_type, policy
        self.asked: list[Tensor] = []

    def forward(self, observation: Tensor) -> Tensor:
        self.asked.append(observation)
        return self.policy.scores(observation)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 4), st.integers(1, 12), st.booleans(), st.sampled_from(("discrete", "continuous")))
def test_queries_per_iteration_are_directions_and_base_point(
    steps: int, directions: int, random_start: bool, action_type: ActionType
) -> None:
    attack = ZOSignSGD(steps=steps, directions=directions, early_stop=False, random_start=random_start)
    policy = Counting(victim(action_type))
    _, spent = perturb(attack, policy, observations(3))
    assert spent.tolist() == [steps * (directions + 1) + random_start] * 3
    assert sum(len(asked.flatten(0, -3)) for asked in policy.asked) == int(spent.sum())


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 80), st.booleans())
def test_zo_stops_at_the_query_budget(queries: int, random_start: bool) -> None:
    attack = ZOSignSGD(steps=3, directions=20, early_stop=False, random_start=random_start)
    _, spent = perturb(attack, victim("discrete"), observations(3), ObservationThreat(queries=queries))
    assert spent.tolist() == [min(queries, 63 + random_start)] * 3 or int(spent.max()) == queries - 1


@pytest.mark.parametrize("objective", ["collision", "expected", "margin", "target", "thesis"])
def test_early_stop_saves_queries_and_meets_the_same_goals(objective: ZOObjective) -> None:
    policy, observation, threat = victim("discrete"), observations(200), ObservationThreat(norm="linf", budget=0.8)
    attack = ZOSignSGD(objective=objective, steps=5, directions=20)
    stopped, few = perturb(attack, policy, observation, threat)
    full, many = perturb(replace(attack, early_stop=False), policy, observation, threat)
    bound: Objective = "target" if objective == "thesis" else objective
    loss = loss_of(policy, bound, observation)
    most = attack.steps * (attack.directions + 1)
    assert int(many.min()) == int(many.max()) == most
    assert float(few.double().mean()) < 0.95 * most
    met = loss.met(policy.scores(stopped))
    assert torch.equal(met, loss.met(policy.scores(full)))
    assert bool((few[~met] == most).all())


def test_a_goal_met_at_the_start_costs_one_query() -> None:
    policy, observation = victim("discrete"), observations(200)
    already = policy.decide(observation) == 3
    assert bool(already.any())
    shown, spent = perturb(ZOSignSGD(objective="target"), policy, observation)
    assert bool((spent[already] == 1).all())
    assert torch.equal(shown[already], observation[already])


def test_a_smaller_goal_needs_fewer_queries() -> None:
    policy, observation = victim("discrete"), observations(200)
    spent = [perturb(ZOSignSGD(enough=enough), policy, observation)[1].double().mean() for enough in (0.5, 1.0)]
    assert float(spent[0]) < float(spent[1])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 99))
def test_the_result_is_never_worse_for_the_attacker_than_no_perturbation(seed: int) -> None:
    policy, observation = victim("discrete", seed), observations(20, seed)
    attacked, clean = (left(attack, policy, observation) for attack in (ZOSignSGD(), None))
    assert bool((attacked <= clean + 1e-5).all())


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 99), st.floats(0.01, 1))
def test_as_many_directions_as_entries_find_the_optimum_of_a_linear_victim(seed: int, smoothing: float) -> None:
    """Orthogonal directions that span the space give the exact gradient of a linear function."""
    policy = Linear(seed)
    # No entry is cut off by the sensors' range, and the set is the same for each, so the loss stays linear.
    observation = torch.cat((torch.ones(6, 4, 1), observations(6, seed)[..., 1:] * 0.5), -1)
    threat = ObservationThreat(norm="linf", budget=0.1)
    attack = ZOSignSGD(steps=2, directions=16, smoothing=smoothing, objective="margin", early_stop=False)
    shown, _ = perturb(attack, policy, observation, threat)
    action = policy.decide(observation)
    slope = (policy.layer.weight[action] - policy.layer.weight[1 - action]).view_as(observation)[..., 1:]
    clear = slope.abs() > 1e-2
    torch.testing.assert_close((shown - observation)[..., 1:][clear], (-0.1 * slope.sign())[clear])


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 70), st.integers(1, 12), st.integers(0, 99))
def test_directions_are_distinct_signs_that_leave_presence_alone(count: int, vehicles: int, seed: int) -> None:
    directions = _directions(count, torch.Size((vehicles, 5)), [torch.Generator().manual_seed(seed)])[0]
    assert directions.shape == (count, vehicles, 5)
    assert bool((directions[..., 0] == 0).all())
    assert bool((directions[..., 1:].abs() == 1).all())


def test_as_many_directions_as_a_full_hadamard_matrix_are_orthogonal() -> None:
    directions = _directions(16, torch.Size((4, 5)), [torch.Generator().manual_seed(0)])[0].flatten(1)
    torch.testing.assert_close(directions @ directions.T, 16 * torch.eye(16))


def test_zo_beats_noise_on_its_objective() -> None:
    policy, observation = victim("discrete"), observations(300)
    attacked, noisy, clean = (left(attack, policy, observation) for attack in (ZOSignSGD(), Noise(), None))
    assert float((clean - attacked).mean()) > 2 * float((clean - noisy).mean())


def test_a_heavier_distortion_weight_leaves_a_smaller_perturbation() -> None:
    policy, observation = victim("discrete"), observations(200)
    sizes = []
    for weight in (0.0, 100.0):
        attack = ZOSignSGD(objective="thesis", distortion_weight=weight, early_stop=False)
        sizes.append(float(distortion(perturb(attack, policy, observation)[0], observation).mean()))
    assert sizes[1] < sizes[0]


@pytest.mark.parametrize("objective", ["collision", "expected", "margin", "target", "thesis"])
def test_a_continuous_victim_moves_towards_the_objective(objective: ZOObjective) -> None:
    policy, observation = victim("continuous"), observations(200)
    shown, _ = perturb(ZOSignSGD(objective=objective, distortion_weight=0.01), policy, observation)
    before, after = policy.decide(observation), policy.decide(shown)
    if objective == "margin":
        assert float((after - before).norm(dim=-1).mean()) > 0.1
    else:
        target = torch.tensor([1.0, 0.5])
        assert float((after - target).norm(dim=-1).mean()) < float((before - target).norm(dim=-1).mean())


@settings(deadline=None)
@given(sizes=st.lists(st.integers(1, 4), min_size=2, max_size=5), count=st.integers(1, 20), seed=st.integers(0, 2**31))
def test_the_gradient_of_a_unit_does_not_depend_on_others_in_the_batch(sizes: list[int], count: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    ends = list(accumulate(sizes, initial=0))
    parts = [Part(slice(start, end), generator) for start, end in pairwise(ends)]
    value, directions = (
        torch.randn(count + 1, ends[-1]),
        _directions(count, torch.Size((5, 5)), [generator] * len(sizes)),
    )
    together = _gradient(value, directions, parts)
    for part, own in zip(parts, directions, strict=True):
        alone = value[:, part.rows].contiguous()
        assert torch.equal(
            together[part.rows], _gradient(alone, own[None], [Part(slice(0, alone.shape[1]), generator)])
        )
