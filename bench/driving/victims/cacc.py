"""Cooperative adaptive cruise control with a constant time gap (Ploeg et al. 2011), and the same without messages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Interval
from torch import Tensor

from cavbench.core.ranges import NotNegative
from cavbench.driving import DrivingFacts, Policy, State
from cavbench.driving.victims.platoon_rows import Follower, PlatoonVictim

Headway = Annotated[float, Interval(ge=0.1, le=5)]


@dataclass(frozen=True, kw_only=True)
class CACC(PlatoonVictim):
    """Keeps a constant time gap, and does what the car ahead says that it is doing (Ploeg et al. 2011, section III).

    The command of the car ahead, as its last message has it, is added to a proportional and derivative control of the gap. It
    is string stable at a time gap at which radar alone is not. Without a message for a second it uses the radar alone.

    Args:
        headway: time gap in s.
        kp, kd: gains in 1/s2 and 1/s.
        ranging: where gap and closing speed are from: the own `radar`, or the `messages` of the car ahead.
    """

    headway: Headway = 0.7
    kp: NotNegative = 0.2
    kd: NotNegative = 0.7
    ranging: Literal["radar", "messages"] = "radar"

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return Cooperative(self, facts).eval()


@dataclass(frozen=True, kw_only=True)
class ACC(PlatoonVictim):
    """Adaptive cruise control: the controller of `cacc` with the radar alone, and no message.

    At low frequencies it is string stable from a headway of sqrt(2 / kp) on: 1.41 s here, and 3.16 s with the gains of `cacc`.

    Args:
        headway: time gap in s.
        kp, kd: gains in 1/s2 and 1/s.
    """

    headway: Headway = 1.5
    kp: NotNegative = 1.0
    kd: NotNegative = 1.4

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return Cooperative(self, facts).eval()


class Cooperative(Follower):
    """The controller of a `CACC` or an `ACC`."""

    def __init__(self, settings: CACC | ACC, facts: DrivingFacts) -> None:
        super().__init__(facts, "victim 'cacc'" if isinstance(settings, CACC) else "victim 'acc'")
        self.settings, self.listens = settings, isinstance(settings, CACC)
        self.radar = not isinstance(settings, CACC) or settings.ranging == "radar"
        self.kept = math.exp(-self.rows.period / settings.headway)

    def command(self, observation: Tensor, state: State) -> Tensor:
        assert state is not None
        settings, platooning = self.settings, self.rows.platooning
        _, vx, ax = self.rows.physical(observation)
        ahead = (
            self.rows.chosen(observation, radar=self.radar)
            if self.listens
            else self.rows.target(observation, platooning.radar)
        )
        error = ahead.gap - platooning.standstill - settings.headway * vx[..., 0]
        change = ahead.closing - settings.headway * ax[..., 0]
        wanted = torch.where(ahead.there, settings.kp * error + settings.kd * change, 0.0)
        if self.listens:
            heard = observation[..., platooning.senders, 0] > 0
            wanted = wanted + torch.where(heard, ax[..., platooning.senders], 0.0)
        return self.kept * state["command"] + (1 - self.kept) * wanted
