"""Policy smoothing: noise on what is seen, a certificate that no attack breaks, and attacks that ask several times."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.attacks.driving.suites import STANDARD_2
from cavbench.core.pair import choose
from cavbench.defenses.driving.smoothing import PolicySmoothing, Smoothed
from cavbench.driving import ObservationThreat, Oracle
from cavbench.driving.access import DRAWS
from cavbench.driving.threat import Norm
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from cavbench.statistics.certificate import certificate
from cavbench.statistics.estimates import Interval
from tests.attacks.driving.victims import observations
from tests.driving.cheats import Victim, drive
from tests.driving.policies import FACTS, Echo
from tests.plugins.toy import ToyPolicy

NORMAL = NormalDist()


def test_every_value_of_a_present_row_gets_noise_and_nothing_else_does() -> None:
    seen = observations(2000, 0)
    change = (Smoothed(Echo(), 0.1).noisy(seen) - seen)[..., 1:]
    present = seen[..., 0] > 0
    assert (change[~present] == 0).all()
    assert change[present].std().item() == pytest.approx(0.1, rel=0.02)
    assert abs(change[present].mean().item()) < 0.002
    torch.testing.assert_close(Smoothed(Echo(), 0.1).noisy(seen)[..., 0], seen[..., 0])


def test_a_victim_with_a_state_or_without_eyes_is_refused() -> None:
    with pytest.raises(UserError, match="without a state"):
        PolicySmoothing().load(choose("victim", "planner").component, 0, FACTS)
    with pytest.raises(UserError, match="that sees"):
        PolicySmoothing().load(choose("victim", "blind").component, 0, FACTS)


@settings(max_examples=40, deadline=None)
@given(
    norm=st.sampled_from(("relative", "linf")), budget=st.floats(0, 2), share=st.floats(0, 1), seed=st.integers(0, 99)
)
def test_no_episode_can_be_changed_by_more_than_the_reach(norm: Norm, budget: float, share: float, seed: int) -> None:
    threat, world = ObservationThreat(norm=norm, budget=budget, share=share), HighwayWorld()
    seen = torch.rand(5, 10, 1 + len(world.features.names), generator=torch.Generator().manual_seed(seed)) * 2 - 1
    seen[..., 0] = 1.0
    largest = float(threat.radius(seen, world.features).flatten(1).norm(dim=1).max()) * math.sqrt(threat.frames(450))
    assert largest <= threat.reach(10, world.features, 450) + 1e-4


@pytest.mark.parametrize(
    "more",
    [
        {"actuator": {"delay": 4}},
        {"actuator": {"replaced": 0.5}},
        {"traffic": {"cars": 1}},
        {"dynamics": {"time_gap": 0.6}},
        {"presence": {"hidden": 1}, "share": 0.01},
    ],
)
def test_what_changes_more_than_observations_leaves_no_certificate(more: dict[str, Any]) -> None:
    """The noise on what is seen hides nothing of other commands and other traffic, nor whether a row is there."""
    reach, alone = (
        ObservationThreat(budget=1e-6, **sets).reach(10, HighwayWorld().features, 450) for sets in (more, {})
    )
    assert certificate(Interval(0.9, 0.8, 1.0), reach / 10) == 0.0
    assert certificate(Interval(0.9, 0.8, 1.0), alone / 10) > 0.5


@pytest.mark.parametrize("shift", [0.0, 0.3, 1.5])
def test_the_certificate_is_what_the_best_attack_leaves(shift: float) -> None:
    """An event of the noise of all frames along one direction; an attack moves along it, one frame after the other."""
    generator = np.random.default_rng(0)
    noise, direction = generator.normal(size=(200_000, 12)), generator.normal(size=12)
    direction /= np.linalg.norm(direction)
    clean = float(np.mean(noise @ direction < 0.8))
    attacked = float(np.mean((noise + shift * direction) @ direction < 0.8))
    assert certificate(Interval(clean, clean, clean), shift) == pytest.approx(attacked, abs=0.004)


def test_the_certificate_falls_with_the_attack_and_knows_its_ends() -> None:
    half = Interval(0.6, 0.5, 0.7)
    assert certificate(half, 0.0) == pytest.approx(0.5)
    assert certificate(half, 1.0) == pytest.approx(NORMAL.cdf(-1.0))
    assert certificate(Interval(0.1, 0.0, 0.2), 0.0) == 0.0
    assert certificate(Interval(0.1, math.nan, math.nan), 0.0) == 0.0
    assert certificate(half, 300.0) == 0.0


class _Summed(Victim):
    """Its scores are linear in what it sees."""

    def forward(self, observation: Tensor) -> Tensor:
        flat = observation.flatten(-2)
        return torch.stack((flat.sum(-1), -flat.sum(-1), *3 * [0 * flat.sum(-1)]), -1)


@pytest.mark.parametrize("sigma", [0.0, 0.3])
def test_a_random_victim_is_asked_several_times_about_each_point(sigma: float) -> None:
    seen: list[tuple[int, int, float]] = []
    inner = _Summed()

    def ask(observation: Tensor, oracle: Oracle) -> None:
        before = oracle.remaining
        scores = oracle.scores(observation)
        cost = int((before - oracle.remaining)[0])
        value, gradient = oracle.gradient(observation[None], lambda given: given[..., 0])
        assert scores.shape == (len(observation), 5)
        assert value.shape == (1, len(observation))
        torch.testing.assert_close(gradient, torch.ones_like(gradient))
        assert oracle.decide(observation).shape == observation.shape[:1]
        noise = (scores - _Summed()(observation))[:, 0]
        seen.append((oracle.draws, cost, float(noise.square().mean())))

    columns = drive(ask, Smoothed(inner, sigma) if sigma else inner, queries=3 * DRAWS)
    draws = DRAWS if sigma else 1
    assert all(one[:2] == (draws, 1) for one in seen)
    assert np.allclose(columns["queries"], 3 * draws)
    if sigma:
        assert np.nanmin(columns["draws"]) >= 2
        values = observations(1, 0)[0, :, 1:].numel()
        assert np.mean([spread for *_, spread in seen]) < 2 * values * sigma**2 / DRAWS
        assert (columns["shift"] > 0).all()
    else:
        assert np.isnan(columns["shift"]).all()


def test_a_continuous_victim_is_asked_for_its_mean_action_and_value() -> None:
    inner = ToyPolicy("continuous", 0).eval()

    def ask(observation: Tensor, oracle: Oracle) -> None:
        scores = oracle.scores(observation)
        assert scores.shape == (len(observation), 2)
        assert oracle.decide(observation).is_floating_point()

    columns = drive(ask, Smoothed(inner, 0.1))
    assert np.allclose(columns["queries"], 2 * DRAWS)


def test_the_attacks_of_the_suite_ask_about_as_many_points_as_before() -> None:
    """Eight draws of each fit into the budget of the suite."""
    attacks = [
        member.chosen.component for member in STANDARD_2.members if member.suits(choose("victim", "dqn").component)
    ]
    asked_of = [one.perturb for one in attacks if one.access in ("scores", "gradients")]
    assert len(asked_of) > 5
    for ask in asked_of:
        once, often = (drive(ask, policy, queries=1000)["queries"] for policy in (Victim(), Smoothed(Victim(), 0.05)))
        assert np.allclose(often, DRAWS * once)
