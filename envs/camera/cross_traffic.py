"""The traffic on the crossing road, which has the right of way and brakes for a car that takes it.

Coordinates as in `cavbench.envs.camera.camera`: the line at y = 0, the middle of the ego's lane at x = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from cavbench.detection.stopping import COMFORTABLE_DECELERATION
from cavbench.envs.camera.braking import Brakes, Motion
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
LANE_M = (CROSSING[1] - CROSSING[0]) / 2
EXPECTED_DECELERATION = 4.5
"""A car that must brake harder than this in m/s2 is not expected to stop: most drivers do so for something unexpected only
(AASHTO, A Policy on Geometric Design of Highways and Streets, on stopping sight distance)."""
STANDSTILL_M = 2.0
"""Distance that a vehicle keeps when it stands: the jam distance of Treiber et al. (2000)."""
LEAST_M = 1e-3
"""Distances and decelerations below are taken for this one, so that what is asked for is finite."""


@dataclass(frozen=True)
class CrossTraffic:
    """K draws of the cross traffic, with N vehicles each, as B cars meet them.

    Args:
        half: [K, N, 2], half the length and half the width of a vehicle in m.
        motion: [B, K, N] each; the distance is that of the middle of a vehicle to x = 0, negative beyond it.
        aware_s: [B, K, N], time since a vehicle could see that the car takes its way; 0 before.
        braked_s: [B, K, N], time since it began to brake; 0 before.
    """

    half: Tensor
    motion: Motion
    aware_s: Tensor
    braked_s: Tensor

    @classmethod
    def drawn(cls, seeds: Sequence[int], cars: int = 1) -> CrossTraffic:
        """One draw for each seed, as each of the cars meets it when its drive begins."""
        passes, half = np.empty((len(seeds), 2 * VEHICLES)), np.empty((len(seeds), 2 * VEHICLES, 2))
        for draw, seed in enumerate(seeds):
            rng = np.random.default_rng([seed, STREAM])
            headways = LEAST_HEADWAY_S + rng.exponential(1 / FLOW_PER_S - LEAST_HEADWAY_S, (2, VEHICLES))
            passes[draw] = (-BEFORE_S + np.cumsum(headways, 1)).ravel()
            sizes = [footprint(model) for model in rng.choice(get_args(Model), 2 * VEHICLES, p=SHARES)]
            half[draw] = [((front - rear) / 2, across) for rear, front, across in sizes]
        distance = (torch.from_numpy(passes).float() * SPEED_MPS).repeat(cars, 1, 1)
        none = torch.zeros_like(distance)
        motion = Motion(distance, torch.full_like(distance, SPEED_MPS), none)
        return cls(torch.from_numpy(half).float(), motion, none.clone(), none.clone())

    @property
    def heading(self) -> Tensor:
        """[N], 1 for the vehicles from the left, -1 for those from the right."""
        return torch.tensor([1.0, -1.0]).repeat_interleave(VEHICLES)

    @property
    def y(self) -> Tensor:
        """[N] of the middle of a vehicle in m."""
        return torch.tensor(LANES).repeat_interleave(VEHICLES)

    @property
    def braked(self) -> Tensor:
        """[B, K], whether a vehicle has begun to brake."""
        return (self.braked_s > 0).any(-1)

    def rectangles(self) -> Tensor:
        """The rectangles [B, K, N, 4] of the vehicles: x0, y0, x1, y1 in m."""
        x = -self.heading * self.motion.distance
        middle = torch.stack((x, self.y.expand_as(x)), -1)
        return torch.cat([middle - self.half, middle + self.half], -1)

    def where(self, chosen: Tensor, other: CrossTraffic) -> CrossTraffic:
        """This traffic for the chosen cars [B], the other one for the rest."""
        each = chosen[:, None, None]
        return CrossTraffic(
            self.half,
            self.motion.where(each, other.motion),
            torch.where(each, self.aware_s, other.aware_s),
            torch.where(each, self.braked_s, other.braked_s),
        )

    def moved(
        self, car: Motion, size: tuple[float, float], brakes: Brakes, reaction_s: float, seconds: float
    ) -> CrossTraffic:
        """The traffic after a short time.

        A vehicle becomes aware of the car when the car is in its lane or must brake harder than `EXPECTED_DECELERATION` to stop
        before it, unless the vehicle is at the car's way already or leaves it before the car arrives. It becomes aware of the
        brake lamps of the vehicle before it, too. A reaction time later it brakes as the driver of the car does
        (`cavbench.detection.driver`): it begins when it must brake comfortably or harder to stand `STANDSTILL_M` before the car's
        way, or behind the place where the vehicle before it will stand. It does not drive on.

        Args:
            car: the motion of the cars, [B] each.
            size: length and width of the car in m.
            brakes: those of all vehicles.
            reaction_s: time from awareness to braking in s.
            seconds: the time.
        """
        length, across = size
        motion, half = self.motion, self.half[..., 0]
        rear, front = motion.distance + half, motion.distance - half
        begins, ends = self.y - LANE_M / 2, self.y + LANE_M / 2
        at, stops = -car.distance[:, None], car.speed.square()[:, None] / (2 * EXPECTED_DECELERATION)
        takes = (at + stops > begins) & (at - length < ends)
        arrives = (begins - at).clamp(min=0) / car.speed[:, None].clamp(min=LEAST_M)
        leaves = (rear + across / 2) / motion.speed.clamp(min=LEAST_M)
        sees = takes[:, None] & (front > across / 2) & (leaves >= arrives[:, None])
        aware_s = torch.where(sees | (self.aware_s > 0), self.aware_s + seconds, 0.0)

        def needed(room: Tensor, known: Tensor) -> Tensor:
            return torch.where(known, motion.speed.square() / (2 * (room - STANDSTILL_M).clamp(min=LEAST_M)), 0.0)

        # The rear of each vehicle when it will stand, and how long its lamps have been on, for the vehicle behind it.
        stands = rear - motion.speed.square() / (2 * motion.braking.clamp(min=LEAST_M))
        before, lit_s = _leader(stands), _leader(self.braked_s)
        wanted = torch.maximum(
            needed(front - across / 2, aware_s >= reaction_s), needed(front - before, lit_s >= reaction_s)
        )
        brakes_now = (self.braked_s > 0) | (wanted >= COMFORTABLE_DECELERATION)
        asked = torch.where(brakes_now, wanted.clamp(min=COMFORTABLE_DECELERATION), 0.0)
        braked_s = torch.where(brakes_now, self.braked_s + seconds, 0.0)
        return CrossTraffic(self.half, brakes.moved(motion, asked, seconds), aware_s, braked_s)


def _leader(values: Tensor) -> Tensor:
    """[B, K, N], the value of the vehicle before each in its lane; 0 for the first."""
    lanes = values.unflatten(-1, (2, VEHICLES))
    return pad(lanes, (1, 0))[..., :-1].flatten(-2)
