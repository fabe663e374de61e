"""Misbehaviour detection: messages are compared with the own radar; after an alarm the radar alone counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from cavbench.core.ranges import NotNegative, Positive
from cavbench.driving import DrivingDefense, DrivingFacts, DrivingVictim, Policy, PolicyWrapper, State, Suspicion
from cavbench.driving.intervals.policy import with_inner
from cavbench.driving.victims.cacc import ACC
from cavbench.driving.victims.platoon_rows import Rows
from cavbench.errors import UserError

MISSING = 1e6
WINDOW = 5
"""Decisions over which a change of speed is compared with what a sender says of its acceleration."""


@dataclass(frozen=True, kw_only=True)
class Misbehaviour(DrivingDefense):
    """Raises an alarm when messages are not plausible, and drives by the radar alone for a while (`acc`).

    The checks are those of VeReMi (van der Heijden et al. 2018) that a car can make that has a radar. Of the car ahead, place and
    speed must be those that the radar measures, and the change of its speed over half a second must fit the acceleration that it
    says. Of every other sender, the change of the told speed must fit the told acceleration. The largest residual over its limit
    is the suspicion; from 1 on there is an alarm. A car ahead that is not heard for a second is an alarm, too.

    Args:
        position: limit of the difference to the radar, in m.
        speed: the same in m/s.
        acceleration: limit of the difference of accelerations, in m/s2; for the other senders, which no radar sees, twice that.
        fallback: who drives after an alarm: `acc`, or the victim (`none`), and the alarm is only recorded.
        headway: time gap of the fallback in s.
        hold_s: how long it drives after the last frame with an alarm, in s.
    """

    made_for: ClassVar[str] = "platoon"

    position: Positive = 3.0
    speed: Positive = 0.8
    acceleration: Positive = 1.4
    fallback: Literal["acc", "none"] = "acc"
    headway: Positive = 1.5
    hold_s: NotNegative = 10.0

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        if facts.platooning is None:
            raise UserError("defense 'misbehaviour' needs messages of other cars: world=platoon")
        if victim.action_type != "continuous":
            raise UserError("defense 'misbehaviour' needs a victim with continuous actions, as cacc and path")
        return Checked(self, victim.load(seed, facts), ACC(headway=self.headway).load(seed, facts), facts).eval()


def _known(values: Tensor) -> Tensor:
    """Values of a state, NaN where they are missing: a state must be equal to itself."""
    return values.masked_fill(values >= MISSING, torch.nan)


class Checked(PolicyWrapper):
    """A policy whose messages are checked. Its state has the last speeds and told accelerations, and both drivers' states."""

    def __init__(self, settings: Misbehaviour, policy: Policy, fallback: Policy, facts: DrivingFacts) -> None:
        super().__init__(policy)
        self.settings, self.fallback = settings, fallback
        self.rows = Rows(facts, "defense 'misbehaviour'")
        self.period, self.count = 1 / facts.decision_hz, facts.rows or 0

    def initial(self, episodes: Tensor) -> State:
        shape = (*episodes.shape, WINDOW, self.count)
        fallback = self.fallback.initial(episodes)
        assert fallback is not None
        own = {
            "speeds": torch.full(shape, MISSING),
            "told": torch.full(shape, MISSING),
            "left": torch.zeros(episodes.shape),
            "fallback": fallback,
        }
        return with_inner(own, self.policy.initial(episodes), episodes.shape)

    def _measured(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Speeds and told accelerations [B, V] of the senders; of the car ahead, the speed is the radar's. NaN where not new."""
        platooning = self.rows.platooning
        _, vx, ax = self.rows.physical(observation)
        speeds = vx[..., :1] + vx
        speeds[..., platooning.senders] = speeds[..., platooning.radar]
        age = observation[..., 1 + self.rows.features.names.index("age")]
        new = (observation[..., 0] > 0) & (age <= -1 + 1e-6)
        new[..., : platooning.senders] = False
        seen = new.clone()
        seen[..., platooning.senders] = observation[..., platooning.radar, 0] > 0
        return speeds.masked_fill(~seen, torch.nan), ax.masked_fill(~new, torch.nan)

    def _level(self, observation: Tensor, state: State, speeds: Tensor, told: Tensor) -> Tensor:
        """The suspicion [B], from what was measured."""
        assert state is not None
        settings, platooning = self.settings, self.rows.platooning
        x, vx, _ = self.rows.physical(observation)
        radar, ahead = platooning.radar, platooning.senders
        both = told[..., ahead].isfinite() & speeds[..., ahead].isfinite()
        place = torch.where(both, (x[..., ahead] - x[..., radar]).abs() / settings.position, 0.0)
        speed = torch.where(both, (vx[..., ahead] - vx[..., radar]).abs() / settings.speed, 0.0)
        # A message says what was commanded in the decision before it.
        before, earlier = (_known(state[name]) for name in ("speeds", "told"))
        change = (speeds - before[:, 0]) / (WINDOW * self.period)
        commands = torch.cat((earlier[:, 1:], told[:, None]), 1)
        off = (change - commands.nanmean(1)).abs() / settings.acceleration
        known = change.isfinite() & (commands.isfinite().sum(1) == WINDOW)
        off = torch.where(known, off, 0.0)
        off[..., ahead + 1 :] *= 0.5
        silent = (observation[..., ahead, 0] <= 0).to(place)
        return torch.stack((place, speed, off.amax(-1), silent)).amax(0)

    def suspicion(self, observation: Tensor, state: State) -> Suspicion:
        level = self._level(observation, state, *self._measured(observation))
        return Suspicion(level, level >= 1)

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        assert state is not None
        scores = self.policy.scores(observation, state.get("inner", None))
        if self.settings.fallback == "none":
            return scores
        taken_over = (state["left"] > 0) | (self._level(observation, state, *self._measured(observation)) >= 1)
        return torch.where(taken_over.unsqueeze(-1), self.fallback.scores(observation, state["fallback"]), scores)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        assert state is not None
        speeds, told = self._measured(observation)
        left = (state["left"] - self.period).clamp(min=0)
        fallback = self.fallback.advance(observation, action, state["fallback"])
        assert fallback is not None
        own = {
            "speeds": torch.cat((state["speeds"][:, 1:], speeds.nan_to_num(MISSING)[:, None]), 1),
            "told": torch.cat((state["told"][:, 1:], told.nan_to_num(MISSING)[:, None]), 1),
            "left": torch.where(self._level(observation, state, speeds, told) >= 1, self.settings.hold_s, left),
            "fallback": fallback,
        }
        return with_inner(own, self.policy.advance(observation, action, state.get("inner", None)), state.batch_size)
