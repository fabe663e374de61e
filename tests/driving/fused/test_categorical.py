"""Actions drawn by compiled calls: torch's probabilities, and never one that is not allowed."""

from __future__ import annotations

import pytest
import torch

from cavbench.driving.fused.categorical import drawn


@pytest.mark.parametrize("masked", [False, True])
def test_actions_are_drawn_with_the_probabilities_of_the_softmax(masked: bool) -> None:
    torch.manual_seed(3)
    scores = torch.tensor([2.0, -1.0, 0.5, 1.0, -40.0])
    allowed = torch.tensor([False, True, True, False, True]) if masked else torch.ones(5, dtype=torch.bool)
    count = 200_000
    action, log_prob = drawn(scores.repeat(count, 1), allowed.repeat(count, 1) if masked else None)
    dist = torch.distributions.Categorical(logits=scores.masked_fill(~allowed, -torch.inf))
    torch.testing.assert_close(log_prob, dist.log_prob(action))
    share = action.bincount(minlength=5) / count
    # Five standard errors.
    assert ((share - dist.probs).abs() <= 5 * (dist.probs * (1 - dist.probs) / count).sqrt()).all()


def test_an_action_is_drawn_from_its_own_row() -> None:
    rows = torch.randint(7, (500,), generator=torch.Generator().manual_seed(0))
    action, log_prob = drawn(100.0 * torch.nn.functional.one_hot(rows, 7), None)
    assert torch.equal(action, rows)
    assert (log_prob == 0).all()
