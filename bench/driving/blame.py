"""Who is to blame for a crash: what the drivers of a batch of episodes did, as a world needs it to drive them again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

AVOIDABLE, AVOIDABLE_IDM, ROOM = COLUMNS = ("avoidable", "avoidable_idm", "room")
"""Names of the measurements of a crash; NaN in an episode without a crash, and where the traffic drives as usual."""
TAKEOVER_S = 5.0
"""Another driver takes the wheel so many seconds before the crash."""
AFTERWARDS_S = 2.0
"""It must not crash until so many seconds after the moment of the crash."""


@dataclass
class Deeds:
    """What the victims and the attacker's cars did in a batch of episodes.

    Args:
        seeds: the scenario seed of each episode [B].
        actions: the victim's action of each decision, [B] or [B, 2].
        orders: the orders of each decision, float64 [B, N, 3] (`cavbench.driving.traffic.Orders`); [B, 0, 3] where no car is
            driven.
    """

    seeds: NDArray[np.int64]
    actions: list[NDArray[np.generic]] = field(default_factory=list)
    orders: list[NDArray[np.float64]] = field(default_factory=list)

    def append(self, action: Tensor, orders: Tensor | None) -> None:
        """Add a decision."""
        self.actions.append(action.detach().numpy().copy())
        self.orders.append(np.zeros((len(action), 0, 3)) if orders is None else orders.numpy().copy())


Judge = Callable[[Deeds, NDArray[np.int64], NDArray[np.bool_]], Mapping[str, NDArray[np.float64]]]
"""From what was done, the decisions [B] and whether each episode crashed [B], the columns of `COLUMNS`, [B] each."""


def unknown(batch: int) -> dict[str, NDArray[np.float64]]:
    """The columns of episodes about which nothing can be said."""
    return {name: np.full(batch, np.nan) for name in COLUMNS}
