"""The controller of the PATH programme: a constant distance, with messages of the car ahead and of the leader."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.ranges import Positive
from cavbench.driving import DrivingFacts, Policy, State
from cavbench.driving.victims.platoon_rows import Follower, PlatoonVictim


@dataclass(frozen=True, kw_only=True)
class PATH(PlatoonVictim):
    """Keeps a constant distance, whatever the speed, by messages of the car ahead and of the leader (Rajamani 2012, section 7.6).

    A constant distance is string stable only with what the leader says (Swaroop and Hedrick 1996). Without a message for a second
    the accelerations count as 0, and the leader as fast as the car ahead.

    Args:
        gap: bumper to bumper, in m.
        c1: weight of the leader against the car ahead, in (0, 1).
        damping: xi, at least 1.
        bandwidth: omega_n in 1/s.
    """

    gap: Positive = 8.0
    c1: Annotated[float, Interval(gt=0, lt=1)] = 0.5
    damping: Annotated[float, Interval(ge=1, le=10)] = 1.0
    bandwidth: Positive = 0.2

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return LeaderFollower(self, facts).eval()


class LeaderFollower(Follower):
    """The controller of a `PATH`. Its state has the last row that a message was in, which is the leader's, too."""

    def __init__(self, settings: PATH, facts: DrivingFacts) -> None:
        super().__init__(facts, "victim 'path'")
        self.settings = settings
        root = settings.damping + math.sqrt(settings.damping**2 - 1)
        self.closing_gain = (2 * settings.damping - settings.c1 * root) * settings.bandwidth
        self.leader_gain = root * settings.bandwidth * settings.c1

    def initial(self, episodes: Tensor) -> State:
        command = torch.zeros(episodes.shape)
        return TensorDict({"command": command, "leader": torch.zeros_like(episodes)}, batch_size=episodes.shape)

    def _leader(self, observation: Tensor, state: State) -> Tensor:
        """int64 [...] the row of the leader."""
        assert state is not None
        numbers = torch.arange(observation.shape[-2], device=observation.device)
        last = (numbers * (observation[..., 0] > 0)).amax(-1)
        return torch.maximum(last, state["leader"]).clamp(min=self.rows.platooning.senders)

    def command(self, observation: Tensor, state: State) -> Tensor:
        settings, senders = self.settings, self.rows.platooning.senders
        _, vx, ax = self.rows.physical(observation)
        leader = self._leader(observation, state).unsqueeze(-1)
        ahead = self.rows.chosen(observation, radar=True)
        present = observation[..., 0] > 0
        said = torch.where(present[..., senders], ax[..., senders], 0.0)
        led = present.gather(-1, leader).squeeze(-1)
        lead_ax = torch.where(led, ax.gather(-1, leader).squeeze(-1), 0.0)
        lead_closing = torch.where(led, vx.gather(-1, leader).squeeze(-1), ahead.closing)
        control = (
            self.closing_gain * ahead.closing
            + self.leader_gain * lead_closing
            + settings.bandwidth**2 * (ahead.gap - settings.gap)
        )
        return (1 - settings.c1) * said + settings.c1 * lead_ax + torch.where(ahead.there, control, 0.0)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        after = super().advance(observation, action, state)
        assert after is not None
        after["leader"] = self._leader(observation, state)
        return after
