"""What a learned driver of the traffic sees from its car, and what its choices mean."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.attacks.driving.driven import GENTLE, LANE_WIDTH, LENGTH, LOST, has_room, lane_centre, room
from cavbench.driving.sets import Traffic
from cavbench.driving.traffic import Orders, View

REACH = 60.0
"""Cars farther ahead of the victim than this, in m, are not driven."""
FEATURES = 12
"""Numbers in a row of what it sees."""
NEAR = 6
"""So many other cars are seen, the nearest to the victim along the road."""
ALONG, ACROSS, FAST, TOP, ANGLE = 30.0, 8.0, 10.0, 30.0, 0.2
"""Units of what it sees: m along and across the road, m/s of a difference and of a speed, rad."""
SIDES = 3
"""Away from the victim's lane, the place of the last order, and towards it."""


def choices(bounds: Traffic) -> Tensor:
    """The accelerations in m/s2 among which it chooses."""
    return torch.tensor([-bounds.braking, -GENTLE, 0.0, bounds.acceleration], dtype=torch.float64)


ACTIONS = 4 * SIDES
"""Each of the accelerations with each of the sides."""


def empty(batch: int, cars: int) -> TensorDict:
    """The seats of B episodes before the first step: the numbers of their cars (0 for none) and the last orders, [B, K] each."""
    zero = torch.zeros(batch, cars, dtype=torch.float64)
    return TensorDict({"car": zero.long(), "acceleration": zero, "y": zero.clone()}, batch_size=[batch])


def seated(view: View, seats: TensorDict) -> TensorDict:
    """The seats, with other cars where there was none, or where one has crashed or was left behind."""
    seats = seats.clone()
    use = (view.x > -LENGTH) & (view.x < REACH) & (view.crashed == 0)
    use[:, 0] = False
    cost = view.x.abs() + 2 * (view.y - view.y[:, :1]).abs()
    for place in range(seats["car"].shape[1]):
        number = seats["car"][:, place]
        car = view.of_car(number)
        lost = (number == 0) | (car.crashed > 0) | (car.x < -LOST) | (car.x > 2 * REACH)
        free = use.scatter(1, seats["car"], False)
        least, best = cost.where(free, torch.inf).min(1)
        best = torch.where(least.isfinite(), best, 0)
        seats["car"][:, place] = torch.where(lost, best, number)
        seats["y"][:, place] = torch.where(lost, lane_centre(view.of_car(best).y), seats["y"][:, place])
        seats["acceleration"][:, place] = torch.where(lost, 0.0, seats["acceleration"][:, place])
    return seats


def side(view: View, seats: TensorDict) -> Tensor:
    """[B, K] -1 if the victim's lane is to the left of the place that was ordered last, otherwise 1."""
    return torch.where(lane_centre(view.y[:, :1]) < seats["y"] - 0.1, -1.0, 1.0).double()


def seen(view: View, seats: TensorDict, bounds: Traffic) -> Tensor:
    """What the drivers in the seats see, float32 [B, K, 1 + NEAR, FEATURES].

    The first row is about the car, the victim and the road, the others are the cars nearest to the victim. Left and right are
    exchanged where the victim is on the left.
    """
    batch, cars = seats["car"].shape
    mirror = side(view, seats)
    ego = View(*(values[:, :1] for values in view))
    own = View(*(values.gather(1, seats["car"]) for values in view))
    lane = lane_centre(ego.y)
    free = torch.stack([has_room(view, number, lane[:, 0], bounds) for number in seats["car"].unbind(1)], 1)
    width = LANE_WIDTH * (own.lanes - 1)
    left, right = own.y, width - own.y
    first = [
        torch.ones_like(own.x),
        own.x / ALONG,
        (own.x - room(ego.speed, bounds)) / 10,
        mirror * (own.y - ego.y) / ACROSS,
        (own.speed - ego.speed) / FAST,
        (ego.speed / TOP).expand_as(own.x),
        mirror * own.heading / ANGLE,
        mirror * ego.heading / ANGLE,
        mirror * (seats["y"] - own.y) / ACROSS,
        free.double(),
        seats["acceleration"] / 5,
        torch.where(mirror > 0, left, right) / ACROSS,
    ]
    others = view.x.abs().index_fill(1, torch.tensor([0]), torch.inf)
    apart, near = others.topk(min(NEAR, others.shape[1]), 1, largest=False)
    rows = torch.zeros(batch, cars, 1 + NEAR, FEATURES)
    rows[:, :, 0] = torch.stack(first, -1)
    there = View(*(values.gather(1, near)[:, None].expand(-1, cars, -1) for values in view))
    mine = near[:, None] == seats["car"][..., None]
    more = [
        torch.ones_like(there.x),
        there.x / ALONG,
        (there.x - own.x[..., None]) / ALONG,
        mirror[..., None] * (there.y - ego.y[..., None]) / ACROSS,
        (there.speed - ego.speed[..., None]) / FAST,
        mirror[..., None] * (there.y - own.y[..., None]) / ACROSS,
    ]
    present = (apart < 2 * REACH)[:, None] & ~mine
    rows[:, :, 1 : 1 + near.shape[1], : len(more)] = (torch.stack(more, -1) * present[..., None]).float()
    return rows.clamp(-4, 4)


def told(view: View, seats: TensorDict, choice: Tensor, bounds: Traffic) -> TensorDict:
    """The seats with the orders that the choices [B, K] mean."""
    seats = seats.clone()
    way = choice % SIDES - 1
    lane, mirror = lane_centre(view.y[:, :1]), side(view, seats)
    aim = seats["y"] + mirror * LANE_WIDTH * way
    # Towards the victim's lane is never beyond it.
    aim = torch.where((way > 0) & (lane == lane_centre(seats["y"])), seats["y"], aim)
    width = LANE_WIDTH * (view.lanes[:, :1] - 1)
    seats["y"] = torch.minimum(aim.clamp(min=0), width)
    seats["acceleration"] = choices(bounds)[choice // SIDES]
    return seats


def orders(view: View, seats: TensorDict) -> Orders:
    """The orders to the cars in the seats."""
    given = Orders.none(view)
    for name, tensor in (("acceleration", given.acceleration), ("y", given.y)):
        tensor.scatter_(1, seats["car"], seats[name])
    given.driven.scatter_(1, seats["car"], True)
    given.driven[:, 0] = False
    return given
