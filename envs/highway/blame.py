"""Could a crash have been avoided? Other drivers take the wheel before it, among the same driven cars."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavbench.driving.blame import AFTERWARDS_S, AVOIDABLE, AVOIDABLE_IDM, ROOM, TAKEOVER_S, Deeds, unknown
from cavbench.driving.features import Driver
from cavbench.driving.rss import safe_distance
from cavbench.envs.highway.clairvoyant import HELD_S, ClairvoyantPlanner
from cavbench.envs.highway.config import HighwayConfig
from cavbench.envs.highway.dynamics import LANE_WIDTH, VEHICLE_LENGTH, VEHICLE_WIDTH
from cavbench.envs.highway.engine import HighwayEngine
from cavbench.envs.highway.ordered import SAME_PLACE, SIDE_MARGIN
from cavbench.envs.highway.state import Integers

CRUISE = 25.0
"""Target speed of the drivers that take over, in m/s: that of the ego at the start (`cavbench.envs.highway.spawn`)."""


class Moment(NamedTuple):
    """The states of episodes when the wheel is taken: copies of the engine's arrays."""

    vehicles: NDArray[np.void]
    order: Integers
    episodes: NDArray[np.void]


def blame(
    config: HighwayConfig, deeds: Deeds, decisions: Integers, crashed: NDArray[np.bool_]
) -> dict[str, NDArray[np.float64]]:
    """The measurements of `cavbench.driving.blame`, [B] each.

    Args:
        config: configuration of the B episodes as they were driven.
        deeds: what was done in them.
        decisions: decisions of each episode [B].
        crashed: whether it ended in a crash [B].
    """
    found = unknown(len(crashed))
    rows = np.flatnonzero(crashed)
    if not len(rows):
        return found
    own = replace(config, cells=tuple(config.cells[row] for row in rows))
    ends = decisions[rows]
    held = max(1, round(HELD_S * config.policy_frequency))
    # The planner chooses in every `held`-th decision.
    takeover = np.maximum(ends - round(TAKEOVER_S * config.policy_frequency), 0) // held * held
    orders = np.stack([orders[rows] for orders in deeds.orders], 1)
    if not orders.shape[2]:
        orders = np.zeros((*orders.shape[:2], config.vehicles + 1, 3))
    moment, found[ROOM][rows] = _again(own, deeds, rows, orders, ends, takeover)
    # Nobody gives orders after the crash.
    orders[np.arange(orders.shape[1]) >= ends[:, None]] = 0.0
    length = ends - takeover + round(AFTERWARDS_S * config.policy_frequency)
    drivers: tuple[tuple[str, Driver], ...] = ((AVOIDABLE, "clairvoyant"), (AVOIDABLE_IDM, "idm"))
    for name, driver in drivers:
        found[name][rows] = ~_fails(own, driver, moment, orders, length)
    return found


def _again(
    config: HighwayConfig, deeds: Deeds, rows: Integers, orders: NDArray[np.float64], ends: Integers, takeover: Integers
) -> tuple[Moment, NDArray[np.float64]]:
    """Drive the episodes again as they were: the states at `takeover`, and the room at the last manoeuvre of a driven car.

    The room is the distance to the ego, bumper to bumper, over RSS's safe distance; NaN without a manoeuvre in its way.
    """
    engine = HighwayEngine(config)
    engine.reset(np.arange(len(rows)), deeds.seeds[rows])
    # Where the world is at the wheel, it does not do what the victim decides.
    planner = ClairvoyantPlanner(engine) if config.driver == "clairvoyant" else None
    kept = Moment(engine.vehicles.copy(), engine.order.copy(), engine.episodes.copy())
    room = np.full(len(rows), np.nan)
    for step in range(int(ends.max())):
        due = takeover == step
        for copy, now in zip(kept, (engine.vehicles, engine.order, engine.episodes), strict=True):
            copy[due] = now[due]
        before = engine.vehicles.copy()
        engine.order_cars(orders[:, step])
        room = np.where(step < ends, _room(before, engine.vehicles, room), room)
        engine.step(deeds.actions[step][rows] if planner is None else planner.actions())
    return kept, room


def _room(before: NDArray[np.void], after: NDArray[np.void], room: NDArray[np.float64]) -> NDArray[np.float64]:
    """The room [R] after orders were taken; as before where no manoeuvre began."""
    place = np.where(before["ordered"], before["ordered_y"], LANE_WIDTH * before["target_lane"])
    moved = np.abs(after["ordered_y"] - place) > SAME_PLACE
    braked = after["braking"] & ~(before["braking"] & before["ordered"])
    # Only a manoeuvre in the ego's way concerns it.
    in_the_way = np.abs(after["ordered_y"] - after["y"][:, :1]) < VEHICLE_WIDTH + SIDE_MARGIN
    begun = after["ordered"] & (moved | braked) & in_the_way
    ahead = after["x"] - after["x"][:, :1]
    speed, ego = after["speed"], np.broadcast_to(after["speed"][:, :1], after.shape)
    safe = safe_distance(np.where(ahead > 0, ego, speed), np.where(ahead > 0, speed, ego))
    gap = np.maximum(np.abs(ahead) - VEHICLE_LENGTH, 0.0)
    share = np.where(begun, gap / np.maximum(safe, 0.1), np.inf).min(1)
    return np.where(np.isfinite(share), share, room)


def _fails(
    config: HighwayConfig, driver: Driver, moment: Moment, orders: NDArray[np.float64], length: Integers
) -> NDArray[np.bool_]:
    """Whether a driver that takes the wheel crashes or leaves the road within `length` [R] decisions.

    Args:
        orders: [R, T, N, 3], the orders of each decision of the episode.
    """
    engine = HighwayEngine(replace(config, driver=driver, action_type="discrete", max_steps=config.max_steps * 2))
    engine.vehicles[:], engine.order[:], engine.episodes[:] = moment
    ego = engine.vehicles[:, 0]
    speeds = np.asarray(config.target_speeds)
    # A continuous victim has no target, and IDM drives at the speed of the start.
    if driver == "idm" or config.action_type == "continuous":
        ego["target_speed"] = speeds[np.abs(speeds - CRUISE).argmin()]
    if config.action_type == "continuous":
        ego["target_lane"] = ego["lane"]
    planner = ClairvoyantPlanner(engine, orders) if driver == "clairvoyant" else None
    nothing, failed = np.ones(len(length), np.int64), np.zeros(len(length), np.bool_)
    for step in range(int(length.max())):
        place = np.minimum(engine.episodes["steps"], orders.shape[1] - 1)
        now = orders[np.arange(len(length)), place]
        now = np.where((engine.episodes["steps"] < orders.shape[1])[:, None, None], now, 0.0)
        engine.order_cars(now)
        engine.step(nothing if planner is None else planner.actions())
        failed |= engine.episodes["terminated"] & (step < length)
    return failed
