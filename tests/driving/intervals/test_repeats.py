"""Observations that stand in a batch more than once are found, and each has the answer that it has alone."""

from __future__ import annotations

from unittest.mock import patch

import torch

from cavbench.defenses.driving.shield import Shield, Shielded
from cavbench.driving.intervals import belief, mask
from cavbench.driving.intervals.repeats import distinct
from cavbench.driving.victims.networks import QPolicy
from tests.driving.intervals.drivers import FACTS
from tests.driving.intervals.test_belief import believing
from tests.driving.intervals.test_mask import drawn

ROWS = torch.tensor([3, 0, 3, 1, 1, 5, 0, 3])


def test_rows_are_the_same_only_with_their_tracks_and_ego() -> None:
    shown, ego, tracks = torch.randn(6, 4, 5)[ROWS], torch.randn(6, 7)[ROWS], torch.randn(6, 3, 9)[ROWS]
    found = distinct(shown, tracks, ego)
    assert found is not None
    assert found.place.tolist() == [0, 1, 0, 2, 2, 3, 1, 0]
    assert found.tracks is not None
    for of, all_ in ((found.observation, shown), (found.ego, ego), (found.tracks, tracks)):
        assert torch.equal(of[found.place], all_)
    ego[2, 6] += 1
    tracks[4, 2, 8] += 1
    shown[6, 0, 0] += 1
    found = distinct(shown, tracks, ego)
    assert found is not None
    assert found.place.tolist() == [0, 1, 2, 3, 4, 5, 6, 0]
    assert distinct(shown[:7], tracks[:7], ego[:7]) is None
    assert distinct(shown[:0], None, ego[:0]) is None


def test_a_zero_and_its_negative_are_two() -> None:
    shown = torch.zeros(2, 4, 5)
    assert distinct(shown, None, torch.zeros(2, 7)) is not None
    shown[1, 2, 2] = -0.0
    assert distinct(shown, None, torch.zeros(2, 7)) is None


def test_a_filter_answers_each_of_them_once() -> None:
    network = QPolicy(5, len(FACTS.actions), 16).requires_grad_(False)
    shown, state = drawn(4, 6)
    for policy, module in ((believing(), belief), (Shielded(Shield(), network, FACTS).eval(), mask)):
        alone = policy.scores(shown, state)[ROWS]
        with patch.object(module, "_score", side_effect=module._score) as asked:
            assert torch.equal(policy.scores(shown[ROWS], state[ROWS]), alone)
        assert len(asked.call_args.args[0]) == 4
        folded = policy.scores(shown[ROWS].view(2, 4, *shown.shape[1:]), state[ROWS].view(2, 4))
        assert torch.equal(folded.flatten(0, 1), alone)
