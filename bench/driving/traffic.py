"""Cars of the traffic that an attacker drives: what it sees of them, and the orders that it gives.

The bounds are those of `cavbench.driving.sets.Traffic`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor


class View(NamedTuple):
    """The cars of B episodes as the attacker that drives among them sees them, float64 [B, N] each; column 0 is the victim's car.

    A column is a car for the whole episode. Nothing of their plans is in it.
    """

    x: Tensor
    """m along the road, from the victim's car."""
    y: Tensor
    """m across the road from the centre of the leftmost lane; lane i has its centre at 4 i."""
    speed: Tensor
    """m/s"""
    heading: Tensor
    """rad"""
    crashed: Tensor
    """0 or 1"""
    driven: Tensor
    """1 for the cars that the attacker drives"""
    lanes: Tensor
    """[B, N] lanes of the road, the same in all columns"""

    @classmethod
    def parsed(cls, stacked: Tensor) -> View:
        """From the tensor [B, N, 7] of an environment."""
        return cls(*stacked.unbind(-1))

    def of(self, rows: Tensor) -> View:
        """The view of some of the episodes."""
        return View(*(values[rows] for values in self))

    def of_car(self, car: Tensor) -> View:
        """The view of one car of each episode, int64 [B]; [B] each."""
        return View(*(values.gather(1, car[:, None]).squeeze(1) for values in self))


ORDERED = 3
"""Numbers in the order to a car."""


@dataclass
class Orders:
    """What the driven cars of B episodes are to do in the next decision, [B, N] each; column 0, the victim's car, is ignored.

    Args:
        driven: bool, the cars to drive; a car that was driven before and is not named is released.
        acceleration: m/s2.
        y: where to steer to, in m across the road as in `View`.
    """

    driven: Tensor
    acceleration: Tensor
    y: Tensor

    @classmethod
    def none(cls, view: View) -> Orders:
        """Orders that drive no car."""
        zero = torch.zeros_like(view.x)
        return cls(torch.zeros_like(zero, dtype=torch.bool), zero, view.y.clone())

    def joined(self, others: Orders) -> Orders:
        """These orders, and those to other cars."""
        mine = self.driven
        return Orders(
            mine | others.driven,
            torch.where(mine, self.acceleration, others.acceleration),
            torch.where(mine, self.y, others.y),
        )

    def stacked(self) -> Tensor:
        """The orders as one float64 tensor [B, N, 3], as environments take them."""
        return torch.stack([getattr(self, field.name).to(torch.float64) for field in fields(self)], -1)
