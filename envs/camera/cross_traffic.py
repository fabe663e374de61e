"""The traffic on the crossing road, which has the right of way.

Coordinates as in `cavbench.envs.camera.camera`: the line at y = 0, the middle of the ego's lane at x = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from cavbench.envs.camera.street.layout import CROSSING
from cavbench.envs.camera.street.vehicles import SHARES, Model, footprint

SPEED_MPS = 50 / 3.6
"""Speed of the cross traffic."""
FLOW_PER_S = 400 / 3600
"""Vehicles a second in each direction."""
LEAST_HEADWAY_S = 2.0
"""Smallest time between two vehicles of a lane. The rest of a headway is exponential (Cowan 1975, model M2)."""
BEFORE_S, VEHICLES = 20.0, 40
"""The traffic begins this long before the car does; vehicles in each direction, enough for a minute."""
STREAM = 20
"""Tells the random numbers of the cross traffic from others of the same seed."""
LANES = (0.75 * CROSSING[0] + 0.25 * CROSSING[1], 0.25 * CROSSING[0] + 0.75 * CROSSING[1])
"""y of the middles of the lanes: the near one carries the traffic from the left, the far one that from the right."""


@dataclass(frozen=True)
class CrossTraffic:
    """K draws of the cross traffic, with N vehicles each; vehicles do not react to the car.

    Args:
        passes: [K, N], time in s at which the middle of a vehicle passes x = 0.
        speed: [N] along x in m/s; negative from the right.
        y: [N] of the middle in m.
        half: [K, N, 2], half the length and half the width in m.
    """

    passes: Tensor
    speed: Tensor
    y: Tensor
    half: Tensor

    @classmethod
    def drawn(cls, seeds: Sequence[int]) -> CrossTraffic:
        """One draw for each seed."""
        passes, half = np.empty((len(seeds), 2 * VEHICLES)), np.empty((len(seeds), 2 * VEHICLES, 2))
        for draw, seed in enumerate(seeds):
            rng = np.random.default_rng([seed, STREAM])
            headways = LEAST_HEADWAY_S + rng.exponential(1 / FLOW_PER_S - LEAST_HEADWAY_S, (2, VEHICLES))
            passes[draw] = (-BEFORE_S + np.cumsum(headways, 1)).ravel()
            sizes = [footprint(model) for model in rng.choice(get_args(Model), 2 * VEHICLES, p=SHARES)]
            half[draw] = [((front - rear) / 2, across) for rear, front, across in sizes]
        speed = torch.tensor([SPEED_MPS] * VEHICLES + [-SPEED_MPS] * VEHICLES)
        y = torch.tensor([LANES[0]] * VEHICLES + [LANES[1]] * VEHICLES)
        return cls(torch.from_numpy(passes).float(), speed, y, torch.from_numpy(half).float())

    def at(self, seconds: Tensor) -> Tensor:
        """The rectangles [B, K, N, 4] of the vehicles at times [B] in s: x0, y0, x1, y1 in m."""
        x = (seconds[:, None, None] - self.passes) * self.speed
        middle = torch.stack((x, self.y.expand_as(x)), -1)
        return torch.cat([middle - self.half, middle + self.half], -1)
