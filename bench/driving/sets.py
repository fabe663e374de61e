"""The sets of the driving track's threat model beside lies about values: each is empty by default, in physical terms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval

from cavbench.core import ranges
from cavbench.core.ranges import Share
from cavbench.core.sets import changed

Frames = Annotated[int, Interval(ge=0, le=450)]
Cars = Annotated[int, Interval(ge=0, le=50)]


@dataclass(frozen=True, kw_only=True)
class Presence:
    """Cars that are hidden from the victim, and cars that are invented.

    An invented car obeys the ranges of the features. From one frame to the next it moves as a car can
    (`cavbench.driving.invented`).

    Args:
        hidden: real cars that may be hidden at once.
        invented: cars that may be invented at once.
        share: share of the frames of a full episode in which a car may be hidden or invented, rounded down.
    """

    hidden: Cars = 0
    invented: Cars = 0
    share: Share = 1.0

    def __post_init__(self) -> None:
        ranges.check(self)
        if self.share != 1 and not (self.hidden or self.invented):
            raise ValueError("share alone allows nothing: give hidden or invented, too")


@dataclass(frozen=True, kw_only=True)
class Latency:
    """A sensor that is late. What was measured later is never shown earlier.

    Args:
        frames: largest age of what is shown, in decisions.
    """

    frames: Frames = 0

    def __post_init__(self) -> None:
        ranges.check(self)


@dataclass(frozen=True, kw_only=True)
class Held:
    """A frozen sensor: the frame shown before is shown again.

    Args:
        share: share of the frames of a full episode that may be such repetitions, rounded down.
        longest: largest number of repetitions in a row.
    """

    share: Share = 0.0
    longest: Frames = 0

    def __post_init__(self) -> None:
        ranges.check(self)
        if bool(self.share) != bool(self.longest):
            missing = "longest" if self.share else "share"
            raise ValueError(f"{missing} is 0, so nothing may be held: give both share and longest")


@dataclass(frozen=True, kw_only=True)
class Actuator:
    """Commands that are executed late or otherwise than they were given.

    `noise` and `replaced` are the noisy and the probabilistic action-robust MDP of Tessler et al. 2019 (NR-MDP and PR-MDP).

    Args:
        delay: frames by which a command may be executed late.
        offset: largest shift of each control of a continuous action, as a share of its limit (m/s2 or rad).
        noise: alpha of the NR-MDP: the car executes (1 - alpha) a + alpha b of the victim's continuous action a and the
            attacker's b.
        replaced: alpha of the PR-MDP: probability that the attacker's action is executed in a frame; the run draws it.
    """

    delay: Frames = 0
    offset: Annotated[float, Interval(ge=0, le=2)] = 0.0
    noise: Share = 0.0
    replaced: Share = 0.0

    def __post_init__(self) -> None:
        ranges.check(self)


@dataclass(frozen=True, kw_only=True)
class Messages:
    """Messages of other cars that the attacker sends in their name, holds back, or repeats (V2X).

    It owns the senders themselves, their keys included: a false message is as fresh and as well signed as a true one. Which they
    are it decides when it first forges; an owned one stays owned to the end of the episode. It cannot send what the radio loses.

    Args:
        senders: number of cars whose messages it may forge in an episode.
        position, speed, acceleration: largest differences to the true message in m, m/s and m/s2.
        delay: largest age of the content of a message, in decisions; it is told as fresh.
        dropped: share of the frames of a full episode in which messages may be held back, rounded down.
    """

    senders: Cars = 0
    position: Annotated[float, Interval(ge=0, le=400)] = 0.0
    speed: Annotated[float, Interval(ge=0, le=50)] = 0.0
    acceleration: Annotated[float, Interval(ge=0, le=20)] = 0.0
    delay: Frames = 0
    dropped: Share = 0.0

    def __post_init__(self) -> None:
        ranges.check(self)
        given = changed(self)
        if given and not self.senders:
            raise ValueError("senders is 0, so the attacker owns nobody: give senders, too")
        if given.keys() == {"senders"}:
            raise ValueError("senders alone allows nothing: give position, speed, acceleration, delay or dropped, too")


@dataclass(frozen=True, kw_only=True)
class Traffic:
    """Cars of the traffic that the attacker drives, within bounds that a careless driver keeps; the world enforces them.

    A manoeuvre is a change of place across the road, or braking harder than 2 m/s2. It may begin only with room to every car that
    it concerns: the cars beside the new place, or those behind a car that brakes. Bumper to bumper they are at least `gap` and
    `headway` times the speed of the rear one away, and the rear one closes by at most `closing`. A driven car never runs into
    the car ahead by itself: it brakes as hard as it may where that is needed. It stays on the road and does not reverse.

    Args:
        cars: number of cars that the attacker may drive at once. A car that gets no order is released: IDM and MOBIL drive on.
        acceleration: their largest acceleration in m/s2.
        braking: their hardest braking in m/s2.
        lateral_speed: their largest speed across the road in m/s.
        gap, headway, closing: room at the beginning of a manoeuvre, in m, s and m/s.
    """

    cars: Cars = 0
    acceleration: Annotated[float, Interval(ge=0, le=6)] = 3.0
    braking: Annotated[float, Interval(ge=1, le=9)] = 6.0
    lateral_speed: Annotated[float, Interval(ge=0, le=4)] = 1.5
    gap: Annotated[float, Interval(ge=0, le=100)] = 3.0
    headway: Annotated[float, Interval(ge=0, le=10)] = 0.1
    closing: Annotated[float, Interval(ge=0, le=80)] = 8.0

    def __post_init__(self) -> None:
        ranges.check(self)
        if not self.cars and changed(self):
            raise ValueError("cars is 0, so the attacker drives nobody: give cars, too")
