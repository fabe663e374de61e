"""Reads the observation of a car in a platoon: its own motion, its radar, and the messages of the cars ahead."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.driving import ActionType, DrivingFacts, DrivingVictim, Policy, State
from cavbench.driving.platooning import Platooning
from cavbench.errors import UserError


class Target(NamedTuple):
    """The car ahead as one source tells, [...] each: gap bumper to bumper in m, closing speed in m/s (v ahead minus own), and
    whether there is one."""

    gap: Tensor
    closing: Tensor
    there: Tensor


class Rows:
    """The rows of observations [..., V, F] in physical units.

    Args:
        facts: facts of the world.

    Raises:
        UserError: if the world has no messages.
    """

    def __init__(self, facts: DrivingFacts, name: str) -> None:
        if facts.platooning is None:
            raise UserError(f"{name} needs messages of the cars ahead, which this world does not have: world=platoon")
        self.platooning: Platooning = facts.platooning
        self.features, self.period = facts.features, 1 / facts.decision_hz
        self.columns = [facts.features.names.index(feature) for feature in ("x", "vx", "ax")]

    def physical(self, observation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """x, vx and ax [..., V] of all rows."""
        values = self.features.physical(observation)
        x, vx, ax = (values[..., column] for column in self.columns)
        return x, vx, ax

    def target(self, observation: Tensor, row: int) -> Target:
        """The car ahead as the radar or its own message tells."""
        x, vx, _ = self.physical(observation)
        return Target(x[..., row] - self.platooning.length, vx[..., row], observation[..., row, 0] > 0)

    def chosen(self, observation: Tensor, *, radar: bool) -> Target:
        """The car ahead by the wanted source or, where it tells nothing, by the other one."""
        rows = (self.platooning.radar, self.platooning.senders)
        first, second = (self.target(observation, row) for row in (rows if radar else rows[::-1]))
        return Target(
            torch.where(first.there, first.gap, second.gap),
            torch.where(first.there, first.closing, second.closing),
            first.there | second.there,
        )


class PlatoonVictim(DrivingVictim):
    """A controller by rule of a car in a platoon."""

    made_for: ClassVar[str] = "platoon"

    @property
    def action_type(self) -> ActionType:
        return "continuous"

    @property
    def draws(self) -> bool:
        return False


class Follower(Policy):
    """A controller of the car's acceleration. Its state is the last command [B] in m/s2.

    Args:
        facts: facts of the world.
        name: of the victim, for messages.
    """

    action_type = "continuous"

    def __init__(self, facts: DrivingFacts, name: str) -> None:
        super().__init__()
        self.rows = Rows(facts, name)

    def initial(self, episodes: Tensor) -> State:
        return TensorDict({"command": torch.zeros(episodes.shape)}, batch_size=episodes.shape)

    def command(self, observation: Tensor, state: State) -> Tensor:
        """The next command [...] in m/s2."""
        raise NotImplementedError

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        limits, command = self.rows.platooning, self.command(observation, state)
        share = command / limits.braking
        # Within what the car can do; with a gradient beyond it, too (straight-through).
        limited = share.detach().clamp(-1.0, limits.acceleration / limits.braking) + (share - share.detach())
        return limited.unsqueeze(-1)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        assert state is not None
        limits = self.rows.platooning
        command = (action[..., 0] * limits.braking).clamp(max=limits.acceleration)
        return TensorDict({"command": command}, batch_size=state.batch_size)
