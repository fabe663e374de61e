"""How much room each action leaves in the worst case of the intervals, in m."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bench.driving.intervals.ego import DeadReckoning, Ego
from bench.driving.intervals.following import FollowingDistance
from bench.driving.intervals.kernels import FREE
from bench.driving.intervals.rooms import CROSSING_S, Cars, Caution, Rooms

STRADDLING = 1.4
"""The ego is still in the lane that it comes from while it is this far from the middle of its target lane, in m."""
SETTLED_M, SETTLED_RAD = 0.5, 0.1
"""The ego is in its target lane if it is this close to the middle and to its direction."""
KEEPS = 1
"""Number of the option IDLE among FASTER, IDLE and SLOWER."""


class Margins(NamedTuple):
    """Room in the worst case, in m; an action is safe if its margin is at least 0.

    Args:
        stay: of FASTER, IDLE and SLOWER, [..., 3].
        change: of LANE_LEFT and LANE_RIGHT, [..., 2].
        out: of the same as a way out, [..., 2]: in the new lane alone, where staying is not safe and leaves less room
            than leaving; else -`FREE`.
        settled: bool [...], whether the ego is in its target lane.
        straddled: -1 or 1, the side of the lane that the ego is leaving, 0 if there is none, [...].
    """

    stay: Tensor
    change: Tensor
    out: Tensor
    settled: Tensor
    straddled: Tensor

    @property
    def safe(self) -> Tensor:
        """bool [...], whether any action is."""
        return (self.stay >= 0).any(-1) | ((self.change >= 0) & self.changeable).any(-1)

    @property
    def worth_changing(self) -> Tensor:
        """[..., 2] the margins of lane changes, with those of ways out, which are the best that is left, but not safe."""
        return torch.maximum(self.change, self.out)

    @property
    def changeable(self) -> Tensor:
        """bool [..., 2]: from a lane the ego may go to both sides, and from between two back, if the new one is not safe."""
        back = torch.stack([self.straddled < 0, self.straddled > 0], -1) & (self.stay[..., 2:] < 0)
        return self.settled.unsqueeze(-1) | back


class Judge:
    """Computes margins.

    Args:
        reckoning: the ego's kinematics.
        period: seconds per decision.
        caution: what is assumed of other cars.
    """

    def __init__(self, reckoning: DeadReckoning, period: float, caution: Caution) -> None:
        self.reckoning = reckoning
        following = FollowingDistance(reckoning.kinematics, period, caution.seconds, within=(None, CROSSING_S))
        self.rooms = Rooms(reckoning, period, caution, following, steady=KEEPS)

    def __call__(self, ego: Ego, cars: Cars) -> Margins:
        options = torch.stack([self.reckoning.commanded(ego, change) for change in (1, 0, -1)], -1)
        own = self.reckoning.speed_after(ego.speed.unsqueeze(-1), options)
        rooms, rear = self.rooms(ego, cars, own)
        front, cross = rooms.unbind(-3)
        off = ego.y - self.reckoning.kinematics.lane_width * ego.target_lane
        straddled = torch.where(off.abs() > STRADDLING, off.sign(), 0.0)
        side = straddled.unsqueeze(-1)
        leaving = torch.where(side == 0, FREE, torch.where(side < 0, cross[..., 0, :], cross[..., 2, :]))
        stay = torch.minimum(front[..., 1, :], leaving)
        beside = torch.minimum(front[..., [0, 2], KEEPS], rear[..., [0, 2]])
        leave = cross[..., 1:2, KEEPS]
        best = stay.amax(-1, keepdim=True)
        change, out = torch.minimum(beside, leave), torch.where((best < 0) & (best < leave), beside, -FREE)
        exists = torch.stack([ego.target_lane > 0, ego.target_lane < ego.edge], -1)
        return Margins(
            stay=stay,
            change=torch.where(exists, change, -FREE),
            out=torch.where(exists, out, -FREE),
            settled=(off.abs() < SETTLED_M) & (ego.heading.abs() < SETTLED_RAD),
            straddled=straddled,
        )
