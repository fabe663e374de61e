"""What compiled filters and beliefs must do alike."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.defenses.driving.tracker import Tracked, Tracker
from cavbench.driving import Policy
from tests.driving.intervals.drivers import FACTS

Answer = Callable[[Tensor, TensorDict], Tensor]
"""The scores [..., A] about observations [..., V, F] with the states of as many episodes."""


def has_the_same_bits_everywhere(answer: Answer, shown: Tensor, state: TensorDict) -> None:
    """A row of 120 has the same scores and gradient in every batch and place."""

    def both(rows: Tensor) -> tuple[Tensor, Tensor]:
        asked = shown[rows].requires_grad_()
        scores = answer(asked, state[rows])
        return scores.detach(), torch.autograd.grad(scores.sum(), asked)[0]

    scores, slopes = both(torch.arange(120))
    for rows in (torch.arange(120).flip(0), torch.tensor([7]), torch.arange(40, 73), torch.tensor([5, 5, 90])):
        part, slope = both(rows)
        assert torch.equal(part, scores[rows])
        assert torch.equal(slope, slopes[rows])


def has_the_gradient_of_torch(
    answer: Answer,
    shown: Tensor,
    state: TensorDict,
    seed: int,
    by_torch: Callable[[], AbstractContextManager[object]],
    floor: float,
) -> tuple[Tensor, Tensor]:
    """A random sum of each row's scores has torch's gradient to rounding, which is a share of its largest entry and `floor`.

    Both round: where large terms cancel, more of what is left is rounding. Returns how far each row is from torch's, [N], and
    the largest entry of torch's, [N].
    """
    weights = torch.randn(len(shown), len(FACTS.actions), generator=torch.Generator().manual_seed(seed))

    def slope() -> Tensor:
        asked = shown.clone().requires_grad_()
        return torch.autograd.grad((answer(asked, state) * weights).sum(), asked)[0]

    compiled = slope()
    with by_torch():
        reference = slope()
    largest = reference.abs().flatten(1).amax(1)
    apart = (compiled - reference).abs().flatten(1).amax(1)
    assert bool((apart <= 1e-5 * (largest + floor)).all())
    return apart, largest


def takes_several_dimensions_and_none(answer: Answer, shown: Tensor, state: TensorDict) -> None:
    """60 rows, as 4 x 15, and no row at all."""
    flat = answer(shown, state)
    folded = shown.unflatten(0, (4, 15))
    assert torch.equal(answer(folded, state.reshape(4, 15)).flatten(0, 1), flat)
    assert answer(shown[:0], state[:0]).shape == (0, len(FACTS.actions))


def drives_as_by_torch(policy: Policy, shown: Tensor, by_torch: Callable[[], AbstractContextManager[object]]) -> None:
    """Scores and states of 80 episodes over several decisions, with the boxes of the tracker in front."""
    tracked = Tracked(Tracker(), policy, FACTS).eval()
    state = other = tracked.initial(torch.arange(80))
    for step in range(6):
        moved = shown.clone()
        moved[..., 1] = (moved[..., 1] + 0.002 * step * moved[..., 0]).clamp(-1, 1)
        scores = tracked.scores(moved, state)
        with by_torch():
            assert torch.equal(tracked.scores(moved, other), scores)
            other = tracked.advance(moved, scores.argmax(-1), other)
        state = tracked.advance(moved, scores.argmax(-1), state)
    assert isinstance(state, TensorDict)
    assert isinstance(other, TensorDict)
    assert (state == other).all()
