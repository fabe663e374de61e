"""How much room each action leaves in the worst case of the intervals, in m."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cavbench.driving.intervals.ego import UNKNOWN_EDGE, DeadReckoning, Ego
from cavbench.driving.intervals.following import Case, FollowingDistance
from cavbench.driving.intervals.kernels import FREE
from cavbench.driving.intervals.rooms import Cars, Caution, Rooms

CLEARING_M, CLEARING_S = 2.4, 0.6
"""The ego has left its lane when it has moved this far to the side, in m, and needs this time for it, in s."""
PARTS = 3
"""The way out of a lane has this many parts; the time that is left counts from the beginning of each."""
SETTLED_M, SETTLED_RAD = 0.5, 0.1
"""The ego is in its target lane if it is this close to the middle and to its direction."""
KEEPS, CHANGES = 1, 3
"""Numbers of options: IDLE, and a lane change without braking, after FASTER, IDLE and SLOWER."""
STAYS = range(CHANGES)
"""The options FASTER, IDLE and SLOWER."""


class Margins(NamedTuple):
    """Room in the worst case, in m; an action is safe if its margin is at least 0.

    Args:
        stay: of FASTER, IDLE and SLOWER, to the cars ahead, and behind where that is no danger ahead, [..., 3].
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
    def most(self) -> Tensor:
        """bool [..., 3], which of FASTER, IDLE and SLOWER has the most room; of several the slowest."""
        last = self.stay.shape[-1] - 1 - self.stay.flip(-1).argmax(-1)
        return torch.nn.functional.one_hot(last, self.stay.shape[-1]).bool()

    @property
    def worth_changing(self) -> Tensor:
        """[..., 2] the margins of lane changes, with those of ways out, which are the best that is left, but not safe."""
        return torch.maximum(self.change, self.out)

    @property
    def changeable(self) -> Tensor:
        """bool [..., 2]: from a lane the ego may go to both sides, and from between two back, if nothing else is safe."""
        back = torch.stack([self.straddled < 0, self.straddled > 0], -1) & (self.stay < 0).all(-1, keepdim=True)
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
        asked = {
            Case(): STAYS,
            Case(held=CLEARING_S): [CHANGES],
            Case(within=CLEARING_S, held=CLEARING_S): [KEEPS],
            **{Case(within=CLEARING_S * (PARTS - part) / PARTS): STAYS for part in range(PARTS)},
        }
        following = FollowingDistance(reckoning.kinematics, period, caution.seconds, cases=tuple(asked))
        self.rooms = Rooms(reckoning, period, caution, following, steady=KEEPS, asked=tuple(asked.values()))

    def __call__(self, ego: Ego, cars: Cars) -> Margins:
        rooms, rear = self.rooms(ego, cars, *self._options(ego))
        front, held, passed = (rooms[..., case, :, :] for case in range(3))
        off = ego.y - self.reckoning.kinematics.lane_width * ego.target_lane
        settled = (off.abs() < SETTLED_M) & (ego.heading.abs() < SETTLED_RAD)
        straddled, leaving = self._leaving(off, rooms[..., 3:, :, :])
        stay = torch.minimum(front[..., 1, :], leaving)[..., :CHANGES]
        best = stay.amax(-1, keepdim=True)
        behind = rear[..., 1, :CHANGES]
        # During a lane change cars behind count as much as cars ahead.
        stay = torch.where(settled.unsqueeze(-1), _spared(stay, behind), torch.minimum(stay, behind))
        # In the new lane the ego can brake at once, or it need not brake before the car behind has reacted.
        beside = torch.minimum(front[..., [0, 2], KEEPS], rear[..., [0, 2], :CHANGES].amin(-1))
        faster = torch.minimum(held[..., [0, 2], CHANGES], rear[..., [0, 2], CHANGES])
        leave = rooms[..., 3, 1:2, KEEPS]
        change = torch.minimum(beside, leave).maximum(torch.minimum(faster, passed[..., 1:2, KEEPS]))
        out = torch.where((best < 0) & (best < leave), beside, -FREE)
        # LANE_RIGHT may be in vain, and the next decision is then one decision later.
        vain = torch.where(self._right_exists(ego, cars), FREE, stay[..., KEEPS])
        limit = torch.stack([torch.full_like(vain, FREE), vain], -1)
        exists = torch.stack([ego.target_lane > 0, ego.target_lane < ego.edge], -1)
        return Margins(
            stay=stay,
            change=torch.where(exists, torch.minimum(change, limit), -FREE),
            out=torch.where(exists, torch.minimum(out, limit), -FREE),
            settled=settled,
            straddled=straddled,
        )

    def _options(self, ego: Ego) -> tuple[Tensor, Tensor]:
        """The ego's speed after each option, and by how much it slows down from then on, [..., 4] each.

        A lane change keeps the target speed. If that is below the ego's speed, the next decision is FASTER.
        """
        speed = ego.speed.unsqueeze(-1)
        orders = torch.stack([self.reckoning.commanded(ego, change) for change in (1, 0, -1)], -1)
        own = self.reckoning.speed_after(speed, orders)
        kept = orders[..., KEEPS : KEEPS + 1]
        aim = torch.maximum(speed, torch.where(kept < speed, orders[..., :1], kept))
        lost = speed - own[..., KEEPS : KEEPS + 1]
        return torch.cat((own, aim), -1), torch.cat((speed - orders, lost), -1).clamp(min=0)

    def _leaving(self, off: Tensor, rooms: Tensor) -> tuple[Tensor, Tensor]:
        """The side of the lane that the ego is leaving, -1, 1 or 0, [...]; and the room there for each option, [..., O].

        Args:
            off: the ego's distance from the middle of its target lane, in m, [...].
            rooms: rooms to the cars ahead for the time that is left from the beginning of each part, [..., PARTS, 3, O].
        """
        moved = (self.reckoning.kinematics.lane_width - off.abs()) / CLEARING_M
        straddled = torch.where(moved < 1, off.sign(), 0.0)
        part = (moved * PARTS).long().clamp(0, PARTS - 1)[..., None, None, None]
        room = rooms.gather(-3, part.expand(*part.shape[:-3], 1, *rooms.shape[-2:])).squeeze(-3)
        side = straddled.unsqueeze(-1)
        return straddled, torch.where(side == 0, FREE, torch.where(side < 0, room[..., 0, :], room[..., 2, :]))

    def _right_exists(self, ego: Ego, cars: Cars) -> Tensor:
        """bool [...], whether it is known that there is a lane on the right: the edge is known, or a car is surely there."""
        return (cars.rightmost(self.reckoning.kinematics.lane_width) > ego.target_lane) | (ego.edge < UNKNOWN_EDGE)


def _spared(front: Tensor, rear: Tensor) -> Tensor:
    """Margins [..., 3] of FASTER, IDLE and SLOWER, where the room behind limits those for which a faster one has room ahead."""
    faster = torch.cummax(front, -1).values[..., :-1] >= 0
    spared = torch.where(faster, torch.minimum(front[..., 1:], rear[..., 1:]), front[..., 1:])
    return torch.cat((front[..., :1], spared), -1)
