"""A biased sensor has the same offset, as a share of the radius, at every step of an episode."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.attacks.driving.bias import Bias
from cavbench.driving import ObservationThreat
from cavbench.driving.attacker import Attacker
from cavbench.driving.victim import CountedPolicy
from tests.attacks.driving.victims import FEATURES, Linear, observations

EPISODES, STEPS = 5, 6
THREAT = ObservationThreat(budget=0.2, access="oblivious", queries=0)


def inside(step: int) -> Tensor:
    """True observations [episodes, V, F] from which no offset leaves the sensors' range."""
    found = observations(EPISODES, step)
    return torch.cat((found[..., :1], 0.5 * found[..., 1:]), -1)


def episodes(scale: float = 1.0, seed: int = 0, gone: dict[int, int] | None = None) -> tuple[list[Tensor], Attacker]:
    """What is shown at each step; `gone` says from which step on an episode is not running any more."""
    attacker = Attacker(Bias(scale=scale), CountedPolicy(Linear(0)), THREAT, FEATURES, seed=seed)
    ends = torch.tensor([(gone or {}).get(episode, STEPS) for episode in range(EPISODES)])
    found = []
    for step in range(STEPS):
        shown = attacker.show(inside(step), step < ends, None)
        assert not shown.queries.any()
        assert not shown.excess.any()
        found.append(shown.observation)
    return found, attacker


def shares(shown: list[Tensor]) -> Tensor:
    """[steps, episodes, V, F] the share of the radius that each value is off by; NaN where nothing may be changed."""
    found = []
    for step, each in enumerate(shown):
        radius = THREAT.radius(inside(step), FEATURES)
        found.append(torch.where(radius > 0, (each - inside(step)) / radius, torch.nan))
    return torch.stack(found)


@settings(max_examples=20, deadline=None)
@given(scale=st.floats(0.05, 1.0), seed=st.integers(0, 2**40))
def test_the_offset_is_the_same_share_of_the_radius_at_every_step(scale: float, seed: int) -> None:
    found = shares(episodes(scale, seed)[0])
    offset = found.nanmean(0)
    torch.testing.assert_close(found, torch.where(found.isnan(), torch.nan, offset), rtol=0, atol=1e-4, equal_nan=True)
    measured = offset[offset.isfinite()]
    torch.testing.assert_close(measured.abs(), torch.full_like(measured, scale), rtol=0, atol=1e-4)
    assert (measured > 0).any()
    assert (measured < 0).any()


@settings(max_examples=20, deadline=None)
@given(gone=st.dictionaries(st.integers(0, EPISODES - 1), st.integers(1, STEPS - 1), max_size=EPISODES - 1))
def test_an_offset_does_not_depend_on_when_other_episodes_end(gone: dict[int, int]) -> None:
    whole, dropped = episodes()[0], episodes(gone=gone)[0]
    for step in range(STEPS):
        for episode in range(EPISODES):
            running = step < gone.get(episode, STEPS)
            expected = whole[step][episode] if running else inside(step)[episode]
            torch.testing.assert_close(dropped[step][episode], expected, rtol=0, atol=0)


def test_every_seed_and_every_episode_has_another_offset() -> None:
    first, second, again = (shares(episodes(seed=seed)[0]) for seed in (0, 1, 0))
    torch.testing.assert_close(first, again, rtol=0, atol=0, equal_nan=True)
    own = torch.stack([each.nanmean(0).sign().nan_to_num() for each in (first, second)]).flatten(0, 1)
    assert len(own.unique(dim=0)) == 2 * EPISODES


@settings(max_examples=20, deadline=None)
@given(
    scale=st.floats(0.05, 1.0),
    norm=st.sampled_from(["relative", "linf"]),
    budget=st.floats(0, 2),
    seed=st.integers(0, 99),
)
def test_it_stays_in_the_set_of_any_threat_model(scale: float, norm: str, budget: float, seed: int) -> None:
    threat = ObservationThreat(norm=norm, budget=budget, access="oblivious", queries=0)  # type: ignore[arg-type]
    attacker = Attacker(Bias(scale=scale), CountedPolicy(Linear(0)), threat, FEATURES, seed=seed)
    for step in range(3):
        truth = observations(EPISODES, step)
        shown = attacker.show(truth, torch.ones(EPISODES, dtype=torch.bool), None)
        off = (shown.observation - truth).abs()
        assert (off <= threat.radius(truth, FEATURES) + 1e-6).all()
        assert shown.observation.abs().max() <= 1.0
        assert not shown.excess.any()
