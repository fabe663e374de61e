"""One decision of a batch of platoons, and what the driven car observes (compiled)."""

from __future__ import annotations

import math

import numpy as np

from cavbench.compiled import entry_point, inner
from cavbench.envs.platoon.cycles import STARTS
from cavbench.envs.platoon.draws import normal, uniform
from cavbench.envs.platoon.motion import (
    AGENT,
    CACC,
    CLAIRVOYANT,
    DELAY,
    IDM,
    KD,
    KP,
    LENGTH,
    PERIOD,
    STANDSTILL,
    clipped,
    cooperative,
    equilibrium,
    intelligent,
    moved,
)
from cavbench.envs.platoon.state import Flags, Floats, Platoons, Rules

LOST, RADAR, MESSAGE = 3, 4, 5
"""What random numbers are for."""
RADAR_X, RADAR_V, MESSAGE_X, MESSAGE_V = 0.1, 0.05, 0.5, 0.1
"""Deviations of what a radar measures and of what satellites tell a sender, in m and m/s."""
RADAR_RANGE = 150.0
SPAN_X, SPAN_V, SPAN_A, SPAN_AGE = 400.0, 50.0, 10.0, 1.0
"""Ranges of the features."""
TIMEOUT = 10
"""Decisions after which a message is forgotten."""
FULL_S, NOTHING_S, SLOW = 0.5, 3.0, 5.0
"""Time gaps with all and without progress in s, and the speed in m/s below which a gap does not count for more time."""
CLAIRVOYANT_S = DELAY * PERIOD
COLUMNS = 8
REWARD, PROGRESS, SPEED, X, TTC, TIME_GAP, OWN, AHEAD = range(COLUMNS)
"""Columns of a step's numbers: the first five as in `cavbench.envs.highway.engine.Number`; a time gap, two accelerations."""


@entry_point
def start(platoons: Platoons, chosen: np.ndarray, speeds: np.ndarray, rules: Rules) -> None:
    """Place the cars of the platoons `chosen` [R] near their equilibrium; all have heard each other.

    Args:
        speeds: of the platoons at the start, [R], in m/s.
    """
    for row in range(len(chosen)):
        b, speed = chosen[row], speeds[row]
        x = 0.0
        for car in range(platoons.cars[b]):
            law = rules.law if car != platoons.place[b] or rules.ego == AGENT else rules.ego
            headway = CLAIRVOYANT_S if law == CLAIRVOYANT else rules.headway
            if car > 0:
                gap = equilibrium(law, speed, headway)
                x -= LENGTH + gap * (1 + 0.1 * uniform(platoons.seed[b], STARTS, car, 0) * rules.noise)
            platoons.x[b, car], platoons.v[b, car], platoons.a[b, car], platoons.u[b, car] = x, speed, 0.0, 0.0
            platoons.heard[b, car], platoons.silent[b, car] = 0.0, 0
            platoons.said[b, car, 0], platoons.said[b, car, 1], platoons.said[b, car, 2] = x, speed, 0.0
            platoons.age[b, car] = 0
        ahead = platoons.place[b] - 1
        for back in range(DELAY + 1):
            # Before the start everybody drove at the same speed.
            place = (DELAY + 1 - back) % (DELAY + 1)
            platoons.past[b, place, 0] = platoons.x[b, ahead] - speed * PERIOD * back
            platoons.past[b, place, 1], platoons.past[b, place, 2] = speed, 0.0
        platoons.steps[b], platoons.done[b], platoons.crashed[b] = 0, False, False


@inner
def gap_ahead(platoons: Platoons, b: int, car: int) -> float:
    """The gap of a follower, bumper to bumper, in m."""
    return platoons.x[b, car - 1] - platoons.x[b, car] - LENGTH


@inner
def follow(platoons: Platoons, b: int, car: int, rules: Rules) -> float:
    """The next command of a follower that the world drives."""
    gap, closing = gap_ahead(platoons, b, car), platoons.v[b, car - 1] - platoons.v[b, car]
    if rules.law == IDM:
        return intelligent(gap, closing, platoons.v[b, car])
    heard = platoons.heard[b, car] if rules.law == CACC else 0.0
    v, a = platoons.v[b, car], platoons.a[b, car]
    return cooperative(platoons.u[b, car], gap, closing, v, a, heard, rules.headway)


@inner
def shadow(platoons: Platoons, b: int) -> float:
    """The command of the driver with perfect information: what the car ahead did half a second ago, where it did it."""
    ego = platoons.place[b]
    old = platoons.past[b, (platoons.steps[b] + 1) % (DELAY + 1)]
    error = old[0] - LENGTH - STANDSTILL - platoons.x[b, ego]
    return clipped(old[2] + KP * error + KD * (old[1] - platoons.v[b, ego]))


@inner
def drive(platoons: Platoons, b: int, action: float, rules: Rules) -> None:
    """Move the cars of a platoon by one decision."""
    ego = platoons.place[b]
    for car in range(1, platoons.cars[b]):
        if car != ego:
            command = follow(platoons, b, car, rules)
        elif rules.ego == AGENT:
            command = clipped(action)
        elif rules.ego == IDM:
            closing = platoons.v[b, ego - 1] - platoons.v[b, ego]
            command = intelligent(gap_ahead(platoons, b, ego), closing, platoons.v[b, ego])
        else:
            command = shadow(platoons, b)
        platoons.u[b, car] = command
    platoons.u[b, 0] = platoons.leader[b, platoons.steps[b]]
    for car in range(platoons.cars[b]):
        x, v, a = moved(platoons.x[b, car], platoons.v[b, car], platoons.a[b, car], platoons.u[b, car])
        platoons.x[b, car], platoons.v[b, car], platoons.a[b, car] = x, v, a
    platoons.steps[b] += 1
    ahead, place = ego - 1, platoons.steps[b] % (DELAY + 1)
    platoons.past[b, place, 0], platoons.past[b, place, 1] = platoons.x[b, ahead], platoons.v[b, ahead]
    platoons.past[b, place, 2] = platoons.u[b, ahead]


@inner
def listen(platoons: Platoons, b: int, rules: Rules) -> None:
    """Send the messages of a moment; each is lost by itself at each receiver."""
    seed, step, loss = platoons.seed[b], platoons.steps[b], platoons.loss[b]
    ego = platoons.place[b]
    for car in range(1, platoons.cars[b]):
        if car == ego:
            continue
        if uniform(seed, LOST, step, 64 * car + car - 1) >= loss:
            platoons.heard[b, car], platoons.silent[b, car] = platoons.u[b, car - 1], 0
        else:
            platoons.silent[b, car] += 1
            if platoons.silent[b, car] > TIMEOUT:
                platoons.heard[b, car] = 0.0
    for car in range(ego):
        if uniform(seed, LOST, step, 64 * ego + car) >= loss:
            error = rules.noise * MESSAGE_X * normal(seed, MESSAGE, step, 2 * car)
            platoons.said[b, car, 0] = platoons.x[b, car] + error
            error = rules.noise * MESSAGE_V * normal(seed, MESSAGE, step, 2 * car + 1)
            platoons.said[b, car, 1] = max(platoons.v[b, car] + error, 0.0)
            platoons.said[b, car, 2] = platoons.u[b, car]
            platoons.age[b, car] = 0
        else:
            platoons.age[b, car] += 1


@inner
def scaled(value: float, span: float) -> float:
    """A value on [-1, 1]."""
    return min(max(value / span, -1.0), 1.0)


@inner
def observe(platoons: Platoons, b: int, rules: Rules, row: np.ndarray) -> None:
    """Write the observation [V, 5] of a platoon."""
    row[:] = 0.0
    ego, seed, step = platoons.place[b], platoons.seed[b], platoons.steps[b]
    x, v = platoons.x[b, ego], platoons.v[b, ego]
    row[0, 0], row[0, 2], row[0, 3], row[0, 4] = 1.0, scaled(v, SPAN_V), scaled(platoons.a[b, ego], SPAN_A), -1.0
    distance = platoons.x[b, ego - 1] - x
    if distance < RADAR_RANGE:
        distance += rules.noise * RADAR_X * normal(seed, RADAR, step, 0)
        closing = platoons.v[b, ego - 1] - v + rules.noise * RADAR_V * normal(seed, RADAR, step, 1)
        row[1, 0], row[1, 1], row[1, 2], row[1, 4] = 1.0, scaled(distance, SPAN_X), scaled(closing, SPAN_V), -1.0
    for back in range(ego):
        car = ego - 1 - back
        if platoons.age[b, car] > TIMEOUT or back + 2 >= len(row):
            continue
        said, place = platoons.said[b, car], back + 2
        row[place, 0], row[place, 1] = 1.0, scaled(said[0] - x, SPAN_X)
        row[place, 2], row[place, 3] = scaled(said[1] - v, SPAN_V), scaled(said[2], SPAN_A)
        row[place, 4] = scaled(2 * platoons.age[b, car] * PERIOD / SPAN_AGE - 1, 1.0)


@inner
def measure(platoons: Platoons, b: int, numbers: Floats) -> None:
    """Write what a moment is worth, and add reward and progress."""
    ego = platoons.place[b]
    gap, v = gap_ahead(platoons, b, ego), platoons.v[b, ego]
    closing = v - platoons.v[b, ego - 1]
    behind = gap_ahead(platoons, b, ego + 1) if ego + 1 < platoons.cars[b] else math.inf
    platoons.crashed[b] = gap <= 0 or behind <= 0
    if not platoons.crashed[b]:
        share = (NOTHING_S - (gap - STANDSTILL) / max(v, SLOW)) / (NOTHING_S - FULL_S)
        numbers[PROGRESS] += min(max(share, 0.0), 1.0)
    numbers[REWARD] = numbers[PROGRESS]
    numbers[SPEED], numbers[X] = v, platoons.x[b, ego]
    numbers[TTC] = max(gap, 0.0) / closing if closing > 0 else math.inf
    numbers[TIME_GAP] = max(gap, 0.0) / max(v, 1.0)
    numbers[OWN], numbers[AHEAD] = platoons.a[b, ego], platoons.a[b, ego - 1]


@entry_point
def step(platoons: Platoons, actions: Floats, paused: Flags, rules: Rules, numbers: Floats) -> None:
    """Drive one action in every platoon that is neither done nor `paused`.

    Args:
        actions: commands of the driven cars in m/s2, [B].
        numbers: [B, COLUMNS], written; reward and progress are 0 where nothing is driven.
    """
    for b in range(len(actions)):
        numbers[b, REWARD] = numbers[b, PROGRESS] = 0.0
        if platoons.done[b] or paused[b]:
            continue
        for _ in range(rules.repeat):
            drive(platoons, b, actions[b], rules)
            listen(platoons, b, rules)
            measure(platoons, b, numbers[b])
            platoons.done[b] = platoons.crashed[b] or platoons.steps[b] >= rules.steps
            if platoons.done[b]:
                break


@entry_point
def look(platoons: Platoons, rules: Rules, observation: np.ndarray) -> None:
    """Write the observations float32 [B, V, 5]."""
    for b in range(len(observation)):
        observe(platoons, b, rules, observation[b])
