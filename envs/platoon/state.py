"""The state of B platoons in arrays, as the compiled engine takes it."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.platoon.motion import DELAY

Floats: TypeAlias = NDArray[np.float64]
Integers: TypeAlias = NDArray[np.int64]
Flags: TypeAlias = NDArray[np.bool_]


class Platoons(NamedTuple):
    """B platoons of up to N cars, the leader first.

    Args:
        x, v, a, u: place of the centres in m, speed, acceleration and command of the cars, [B, N].
        heard, silent: what each car heard last of the command of the car ahead, and for how many decisions not since, [B, N].
        said: place, speed and command in the last message of each car ahead that the driven car received, [B, N, 3].
        age: of that message in decisions, [B, N].
        past: place, speed and command of the car ahead of the driven one in the last decisions, [B, DELAY + 1, 3].
        leader: commands of the leader, [B, T].
        seed, place, cars, steps: scenario seed, number of the driven car, of cars, and of decisions so far, [B].
        loss: share of messages that is lost, [B].
        done, crashed: [B].
    """

    x: Floats
    v: Floats
    a: Floats
    u: Floats
    heard: Floats
    silent: Integers
    said: Floats
    age: Integers
    past: Floats
    leader: Floats
    seed: Integers
    place: Integers
    cars: Integers
    steps: Integers
    loss: Floats
    done: Flags
    crashed: Flags

    @classmethod
    def empty(cls, batch: int, cars: int, steps: int) -> Platoons:
        """Platoons of which nothing is set."""
        each = (batch, cars)
        x, v, a, u, heard = np.zeros((5, *each))
        silent, age = np.zeros((2, *each), np.int64)
        seed, place, count, done_steps = np.zeros((4, batch), np.int64)
        done, crashed = np.zeros((2, batch), np.bool_)
        return cls(
            x=x,
            v=v,
            a=a,
            u=u,
            heard=heard,
            silent=silent,
            said=np.zeros((*each, 3)),
            age=age,
            past=np.zeros((batch, DELAY + 1, 3)),
            leader=np.zeros((batch, steps)),
            seed=seed,
            place=place,
            cars=count,
            steps=done_steps,
            loss=np.zeros(batch),
            done=done,
            crashed=crashed,
        )


class Rules(NamedTuple):
    """What is the same for all platoons of an engine.

    Args:
        ego: who drives the driven car (`motion.AGENT`, `IDM` or `CLAIRVOYANT`).
        law: how the other followers drive (`motion.CACC`, `ACC` or `IDM`).
        headway: of these followers, in s.
        noise: deviation of the sensors over the usual one.
        repeat: decisions for which an action is held.
        steps: decisions of an episode.
    """

    ego: int
    law: int
    headway: float
    noise: float
    repeat: int
    steps: int
