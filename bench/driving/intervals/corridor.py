"""The continuous actions that are safe in the worst case: a range of accelerations and one of steering angles."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cavbench.driving.intervals.ego import DeadReckoning, Ego
from cavbench.driving.intervals.following import FollowingDistance
from cavbench.driving.intervals.kernels import FREE
from cavbench.driving.intervals.rooms import Cars, Caution, Rooms

LEVELS = 9
"""Number of accelerations for which margins are computed; between them they are interpolated."""
SIDEWAYS = 1.0
"""From this distance to the middle of its lane on, in m, the ego counts as in the next lane as well."""
PLAY = 0.3
"""The ego may be steered as far beyond the middle of the outermost lane that is left to it, in m."""


class Corridor(NamedTuple):
    """What is left to a driver.

    Args:
        low, high: [..., 2] bounds of acceleration and steering, in [-1, 1].
        safe: bool [...], whether the ego can brake in time in the lane to which it is steered.
    """

    low: Tensor
    high: Tensor
    safe: Tensor


class CorridorJudge:
    """Computes corridors.

    Args:
        reckoning: the ego's kinematics.
        period: seconds per decision.
        caution: what is assumed of other cars.
        band: margin in m from which on less than full acceleration is not left.
    """

    def __init__(self, reckoning: DeadReckoning, period: float, caution: Caution, band: float) -> None:
        self.reckoning, self.band = reckoning, band
        limit = reckoning.kinematics.acceleration_limit
        self.gained = limit * period
        speeds = reckoning.kinematics.target_speeds
        self.slowing = speeds[1] - speeds[0]
        following = FollowingDistance(reckoning.kinematics, period, caution.seconds, braking=limit)
        self.rooms = Rooms(reckoning, period, caution, following, steady=LEVELS // 2, asked=(range(LEVELS),))

    def __call__(self, ego: Ego, cars: Cars, edge: Tensor) -> Corridor:
        """The corridor [...].

        Args:
            ego: the ego's motion.
            cars: the other cars.
            edge: the highest number of a lane that is known to exist, [...].
        """
        front, rear = self._rooms(ego, cars)
        lane = ego.target_lane
        off = ego.y - self.reckoning.kinematics.lane_width * lane
        inside = torch.stack([off < -SIDEWAYS, off > SIDEWAYS], -1)
        exists = torch.stack([lane > 0, lane < edge], -1)
        left, own, right = front.unbind(-2)
        # A lane that it is partly in already must leave room to brake, another one room to keep the speed.
        room = torch.stack([left, right], -2)
        beside = torch.where(inside, room[..., 0], torch.minimum(room[..., LEVELS // 2], rear))
        open_ = exists & (beside >= 0)
        # Its own lane is given up where it leaves no room and the ego is partly in one beside it that does.
        gives_up = (own[..., :1] < 0) & open_ & inside
        own = torch.where(gives_up.any(-1, keepdim=True), FREE, own)
        ahead = torch.minimum(own, torch.where(inside.unsqueeze(-1), room, FREE).amin(-2))
        slow, fast = self._accelerations(ego, ahead)
        most_left, most_right = self._steering(ego, open_, gives_up)
        return Corridor(
            torch.stack([slow, most_left], -1), torch.stack([fast, most_right], -1), safe=ahead[..., 0] >= 0
        )

    def _rooms(self, ego: Ego, cars: Cars) -> tuple[Tensor, Tensor]:
        """Room to the cars ahead on the left, own and right lane for each acceleration, [..., 3, LEVELS]; behind, [..., 2]."""
        levels = torch.linspace(-1, 1, LEVELS).to(ego.speed) * self.gained
        own = (ego.speed.unsqueeze(-1) + levels).clamp(min=0)
        front, rear = self.rooms(ego, cars, own, torch.full_like(own, self.slowing))
        return front[..., 0, :, :], rear[..., [0, 2], 0]

    def _accelerations(self, ego: Ego, room: Tensor) -> tuple[Tensor, Tensor]:
        """The lowest and the highest acceleration that is left, [...] in [-1, 1], from the room [..., LEVELS]."""
        car = self.reckoning.kinematics
        wanted = (car.target_speeds[-1] - ego.speed) * (car.speed_gain / car.acceleration_limit)
        slow = torch.minimum(_highest(room - self.band), wanted.clamp(-1, 1))
        return slow, torch.maximum(slow, _highest(room))

    def _steering(self, ego: Ego, open_: Tensor, gives_up: Tensor) -> tuple[Tensor, Tensor]:
        """The lowest and the highest steering that is left, [...] in [-1, 1]: between paths to the outermost lanes."""
        car = self.reckoning.kinematics
        side = torch.tensor([-1.0, 1.0]).to(ego.y)
        far = torch.where(open_, side, 0.0)
        forced = (gives_up * side).sum(-1, keepdim=True)
        far = torch.where(gives_up.any(-1, keepdim=True), forced, far)
        place = car.lane_width * (ego.target_lane.unsqueeze(-1) + far) + PLAY * side
        moving = Ego(*(value.unsqueeze(-1) for value in ego))
        left, right = (self.reckoning.steering(moving, place) / car.steering_limit).clamp(-1, 1).unbind(-1)
        return left, torch.maximum(left, right)


def _highest(room: Tensor) -> Tensor:
    """The highest acceleration [...] in [-1, 1] that leaves room, from that of each level [..., LEVELS]; -1 if none does.

    The room falls with the acceleration; between two levels it is interpolated, with a gradient.
    """
    last = ((room >= 0).sum(-1, keepdim=True) - 1).clamp(0, LEVELS - 2)
    upper, lower = room.gather(-1, last), room.gather(-1, last + 1)
    share = (upper / (upper - lower).clamp(min=1e-6)).clamp(0, 1)
    return ((last + share) * (2 / (LEVELS - 1)) - 1).clamp(max=1).squeeze(-1)
