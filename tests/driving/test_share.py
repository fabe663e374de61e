"""A threat model may allow an attack on a share of the frames only: the run enforces it."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.attacks.driving.noise import Noise
from cavbench.attacks.driving.pgd import PGD
from cavbench.attacks.driving.timing import preference_gap
from cavbench.driving import DrivingAttack, ObservationThreat
from cavbench.driving.attacker import Attacker
from cavbench.driving.victim import CountedPolicy
from tests.attacks.driving.victims import FEATURES, observations, victim

STEPS = 12


def shown_frames(attack: DrivingAttack, threat: ObservationThreat, seed: int = 0) -> Tensor:
    """[STEPS, B] whether the observation of a frame was changed."""
    at_work = Attacker(
        attack, CountedPolicy(victim("discrete")), threat, FEATURES, seed=seed, frames=threat.frames(STEPS)
    )
    running, changed = torch.ones(3, dtype=torch.bool), []
    for step in range(STEPS):
        truth = observations(3, 10 * seed + step)
        changed.append((at_work.show(truth, running, None).observation != truth).flatten(1).any(1))
    return torch.stack(changed)


@settings(max_examples=40, deadline=None)
@given(st.floats(0, 1), st.integers(0, 9))
def test_no_episode_is_attacked_in_more_than_its_share_of_the_frames(share: float, seed: int) -> None:
    threat = ObservationThreat(share=share)
    frames = shown_frames(Noise(), threat, seed).sum(0)
    assert threat.frames(STEPS) <= share * STEPS + 1e-6
    # Noise changes every frame, so it uses the whole allowance.
    assert (frames == threat.frames(STEPS)).all()


def test_three_tenths_of_ten_frames_are_three() -> None:
    assert [ObservationThreat(share=share).frames(10) for share in (0.0, 0.1, 0.3, 0.7, 0.99, 1.0)] == [
        0,
        1,
        3,
        7,
        9,
        10,
    ]


def test_frames_in_which_the_truth_is_shown_do_not_count() -> None:
    attack = PGD(steps=1, restarts=1, gap=0.6, gap_temperature=1.0)
    policy = victim("discrete")
    whole = shown_frames(attack, ObservationThreat())
    gaps = torch.stack([preference_gap(policy.scores(observations(3, step)), 1.0) for step in range(STEPS)])
    assert 0 < int((gaps >= 0.6).sum()) < gaps.numel()
    assert not whole[gaps < 0.6].any()
    limited = shown_frames(attack, ObservationThreat(share=0.25))
    # The attack is spared for the frames with a large gap, and stops after three of them.
    assert torch.equal(limited, whole & (whole.cumsum(0) <= 3))


def test_an_ended_episode_keeps_its_count() -> None:
    threat = ObservationThreat(share=0.5)
    at_work = Attacker(Noise(), CountedPolicy(victim("discrete")), threat, FEATURES, seed=0, frames=2)
    for step, running in enumerate(torch.tensor([[1, 1], [1, 0], [1, 1], [1, 1]]).bool()):
        truth = observations(2, step)
        changed = (at_work.show(truth, running, None).observation != truth).flatten(1).any(1)
        assert changed.tolist() == [step < 2, step in (0, 2)]
