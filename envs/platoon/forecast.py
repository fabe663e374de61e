"""How a platoon moves, for attackers that rehearse: the cars ahead keep their command for a second, then their speed."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench.driving.dynamics import Dynamics, Forecast, Rehearsal
from cavbench.driving.features import ActionType, Features
from cavbench.envs.platoon.engine import COMMANDS, WIDTH
from cavbench.envs.platoon.kernels import FULL_S, NOTHING_S, SLOW
from cavbench.envs.platoon.motion import ACCELERATION, BRAKING, KEPT, LAG, LENGTH, PERIOD, STANDSTILL

COMMAND_S = 1.0
"""For so long the cars ahead are taken to keep their command, in s."""
RADAR, SENDERS = 1, 2


class PlatoonDynamics(Dynamics):
    """The rules of motion of the world `platoon`. A belief is the newest true observation [B, V, 5].

    Args:
        batch: B.
        rows: V.
        features: of the world.
        action_type: kind of the actions.
    """

    period = PERIOD

    def __init__(self, batch: int, rows: int, features: Features, action_type: ActionType) -> None:
        self.batch, self.rows, self.features, self.action_type = batch, rows, features, action_type
        self.actions = len(COMMANDS) if action_type == "discrete" else 0

    def unknown(self) -> TensorDict:
        return TensorDict({"seen": torch.zeros(self.batch, self.rows, WIDTH)}, batch_size=[self.batch])

    def believe(self, observation: Tensor, before: TensorDictBase) -> TensorDict:
        return TensorDict({"seen": observation.to(torch.float32)}, batch_size=[len(observation)])

    def rehearsal(self, belief: TensorDictBase, copies: int) -> PlatoonRehearsal:
        return PlatoonRehearsal(belief["seen"].expand(copies, *belief["seen"].shape), self.features, self.action_type)

    def roll(self, belief: TensorDictBase, plans: Tensor) -> Forecast:
        every = (
            plans
            if plans.ndim == (3 if self.action_type == "discrete" else 4)
            else plans.expand(len(belief), *plans.shape)
        )
        tried = every.transpose(0, 1)
        world = self.rehearsal(belief, len(tried))
        steps = tried.shape[2]
        failed = torch.full(tried.shape[:2], steps, dtype=torch.int64)
        progress = torch.zeros(tried.shape[:2])
        for step in range(steps):
            world.step(tried[:, :, step])
            progress += world.progress
            failed = torch.where(world.failed & (failed == steps), step, failed)
        return Forecast(failed.T, world.failed.T.clone(), progress.T)


class PlatoonRehearsal(Rehearsal):
    """K copies of B platoons, decision by decision."""

    def __init__(self, seen: Tensor, features: Features, action_type: ActionType) -> None:
        self.half, self.action_type = features.half_range(), action_type
        values = features.physical(seen)
        self.present = seen[..., 0] > 0
        # Row 0 is the car itself, at 0; the others are where they are from it.
        self.x = values[..., 0].clone()
        self.v = torch.cat((values[..., :1, 1], values[..., 1:, 1] + values[..., :1, 1]), -1)
        self.u = values[..., 2].clone()
        # The radar does not say what the car ahead is told to do, its message does.
        told = self.present[..., SENDERS]
        self.u[..., RADAR] = torch.where(told, self.u[..., SENDERS], 0.0)
        self.a = self.u.clone()
        self.elapsed = 0
        self.failed = torch.zeros(seen.shape[:2], dtype=torch.bool)
        self.progress = torch.zeros(seen.shape[:2])
        self.observation = torch.zeros_like(seen)
        self._look()

    @property
    def gap(self) -> Tensor:
        """[K, B] from bumper to bumper of the car ahead in m, inf if none is seen."""
        row = torch.where(self.present[..., RADAR], self.x[..., RADAR], self.x[..., SENDERS])
        there = self.present[..., RADAR] | self.present[..., SENDERS]
        return torch.where(there, row - self.x[..., 0] - LENGTH, torch.inf)

    @property
    def time_gap(self) -> Tensor:
        """[K, B] the same over the own speed, in s."""
        return self.gap.clamp(min=0) / self.v[..., 0].clamp(min=1.0)

    def step(self, action: Tensor) -> None:
        if self.action_type == "discrete":
            command = torch.tensor(COMMANDS)[action]
        else:
            command = (action[..., 0] * BRAKING).clamp(-BRAKING, ACCELERATION)
        if self.elapsed * PERIOD >= COMMAND_S:
            self.u[..., 1:] = 0.0
        self.u[..., 0] = command
        a = self.u + (self.a - self.u) * KEPT
        v = self.v + self.u * PERIOD + (self.a - self.u) * LAG * (1 - KEPT)
        a = torch.where(v <= 0, a.clamp(min=0), a)
        v = v.clamp(min=0)
        self.x = self.x + (self.v + v) / 2 * PERIOD
        self.v, self.a = v, a
        self.elapsed += 1
        gap = self.gap
        self.failed = self.failed | (gap <= 0)
        share = (NOTHING_S - (gap - STANDSTILL) / self.v[..., 0].clamp(min=SLOW)) / (NOTHING_S - FULL_S)
        self.progress = torch.where(self.failed, 0.0, share.clamp(0.0, 1.0))
        self._look()

    def _look(self) -> None:
        """The observation of the simulated cars: every message is new."""
        x = self.x - self.x[..., :1]
        v = torch.cat((self.v[..., :1], self.v[..., 1:] - self.v[..., :1]), -1)
        third = self.u.clone()
        third[..., 0], third[..., RADAR] = self.a[..., 0], 0.0
        values = torch.stack((x, v, third), -1) / self.half[:3]
        age = torch.full_like(x, -1.0)
        rows = torch.cat((torch.ones_like(x)[..., None], values.clamp(-1, 1), age[..., None]), -1)
        self.observation = rows * self.present[..., None]
