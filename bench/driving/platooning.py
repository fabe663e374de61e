"""What a driver in a platoon may know of its world: published facts of the cars and of their messages."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Platooning:
    """Cars on one lane whose acceleration follows a command with a lag, and what they are told.

    Row 0 of an observation is the car itself. Row `radar` is the car ahead as the own radar measures it. The rows from `senders`
    on are messages of the cars ahead, nearest first and the leader last; a row is absent where nothing was heard for `timeout`.
    `x` is a distance of centres in m and `vx` a difference of speeds in m/s, but in row 0 the own speed. `ax` in m/s2 is the own
    acceleration in row 0, 0 in the radar's row, and in a message the one that the sender's controller asks for. `age` is the time
    in s since a message was sent.

    Args:
        acceleration, braking: limits of a command, in m/s2, both above 0. A continuous action of -1 is the hardest braking, and
            an action a commands a * braking, at most `acceleration`.
        lag: time constant of the engine and the brakes, in s.
        length: of a car, in m.
        standstill: gap of the controllers at standstill, bumper to bumper, in m.
        timeout: age of a message in s from which it is forgotten.
        radar, senders: numbers of the rows.
    """

    acceleration: float
    braking: float
    lag: float
    length: float
    standstill: float
    timeout: float
    radar: int
    senders: int
