"""The compiled loops compute what torch does, and give a row the same bits in every batch."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import pytest
import torch
from torch import Tensor

from cavbench.driving import ActionType
from cavbench.driving.intervals.boxes import Assumed, Boxes
from cavbench.driving.intervals.ego import DeadReckoning, Ego, fields
from cavbench.driving.intervals.tracks import predicted
from cavbench.driving.threat import Norm
from tests.driving.intervals import by_torch
from tests.driving.intervals.drivers import FACTS

PERIOD = 1 / FACTS.decision_hz


def shown(count: int) -> Tensor:
    """[count, 10, 5] some at the ends of the sensors' ranges, some of absent cars."""
    generator = torch.Generator().manual_seed(count)
    rows = (torch.rand(count, 10, 5, generator=generator) * 2.2 - 1.1).clamp(-1, 1)
    rows[..., 0] = (torch.rand(count, 10, generator=generator) > 0.2).float()
    rows[::7, :, 3] = 0.0
    return rows


def egos(count: int) -> Ego:
    """Egos of all kinds: faster than any target speed, between two lanes, with known and unknown edges."""
    generator = torch.Generator().manual_seed(count)

    def drawn() -> Tensor:
        return torch.rand(count, generator=generator)

    return Ego(
        y=12 * drawn(),
        heading=drawn() - 0.5,
        speed=45 * drawn(),
        target_lane=(4 * drawn()).floor(),
        target_speed=20 + 5 * (3 * drawn()).floor(),
        edge=torch.where(drawn() < 0.5, 3.0, 64.0),
    )


def bounds(of: Boxes) -> Tensor:
    """A number for each episode from all finite bounds, with different weights."""
    both = torch.cat((of.low, of.high), -1)
    weights = torch.arange(both[0].numel()).view(both.shape[1:]).cos()
    return (torch.where(both.isfinite(), both, 0.0) * weights).sum((-2, -1))


@pytest.mark.parametrize("norm", get_args(Norm))
@pytest.mark.parametrize(("budget", "noise", "fixed"), [(0.0, 0.0, ()), (0.1, 0.1, ()), (0.3, 0.5, ("vx",))])
def test_boxes_have_the_bits_of_torch_and_its_gradient(
    norm: Norm, budget: float, noise: float, fixed: tuple[str, ...]
) -> None:
    assumed = Assumed(replace(FACTS.features, fixed=fixed), norm, budget, noise)
    one, other = (shown(200).requires_grad_() for _ in range(2))
    compiled, reference = assumed.boxes(one), by_torch.boxes(assumed, other)
    for mine, wanted in zip(compiled, reference, strict=True):
        assert torch.equal(mine, wanted)
    found, wanted = (torch.autograd.grad(bounds(of).sum(), x)[0] for of, x in ((compiled, one), (reference, other)))
    torch.testing.assert_close(found, wanted, rtol=1e-6, atol=1e-4)
    assert int((wanted != 0).sum()) > 1000


def test_boxes_take_any_leading_shape_and_keep_what_is_no_number() -> None:
    assumed = Assumed(FACTS.features, "relative", 0.1, 0.1)
    x = shown(24)
    x[3, 2, 1] = torch.nan
    flat = assumed.boxes(x)
    nested = assumed.boxes(x.view(4, 6, 10, 5).transpose(0, 1))
    torch.testing.assert_close(nested.low.transpose(0, 1).flatten(0, 1), flat.low, equal_nan=True, rtol=0, atol=0)
    assert bool(flat.low[3, 2, 0].isnan())
    assert bool(flat.high[3, 2, 0].isnan())
    assert assumed.boxes(x[:0]).low.shape == (0, 10, 4)


@pytest.mark.parametrize("action_type", get_args(ActionType))
def test_the_ego_and_the_tracks_are_those_of_torch(action_type: ActionType) -> None:
    reckoning = DeadReckoning(FACTS.kinematics, PERIOD, FACTS.actions, action_type)  # type: ignore[arg-type]
    ego, generator = egos(2000), torch.Generator().manual_seed(0)
    actions = torch.randint(0, len(FACTS.actions), (2000,), generator=generator)
    if action_type == "continuous":
        actions = torch.randn(2000, 2, generator=generator)
    after, wanted = reckoning.after(ego, actions), by_torch.after(reckoning, ego, actions)
    moved, known = fields(after)
    for name in Ego._fields:
        torch.testing.assert_close(getattr(moved, name), getattr(wanted, name), rtol=1e-6, atol=3e-6)
    assert bool(known.all())
    assert torch.equal(reckoning.after(Ego(*(one[-7:] for one in ego)), actions[-7:]), after[-7:])

    boxes = Assumed(FACTS.features, "relative", 0.1, 0.1).boxes(shown(2000))
    found = predicted(boxes, ego, after, FACTS.kinematics, PERIOD)  # type: ignore[arg-type]
    low, high = by_torch.predicted(boxes, ego, wanted, FACTS.kinematics, PERIOD)  # type: ignore[arg-type]
    torch.testing.assert_close(found[..., 1:], torch.cat((low, high), -1), rtol=1e-5, atol=1e-4)
    assert torch.equal(found[..., 0] > 0, boxes.present[..., 1:])
