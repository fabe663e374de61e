"""Dead reckoning: the ego's own motion, from the actions that it has taken. They cannot be forged."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench.driving.features import ActionType
from cavbench.driving.intervals import motion_kernels
from cavbench.driving.intervals.boxes import Boxes
from cavbench.driving.kinematics import Kinematics

UNKNOWN_EDGE = 64
"""The rightmost lane, as long as the car has not found it by steering towards a lane that does not exist."""
OFF_THE_ROAD = 0.3
"""A lane does not exist if the measured place stays this far to the left of the reckoned one, in m."""

SLACK = 1.0
"""The reckoned place and speed are corrected if they are farther outside of the measured box than this, in m and m/s."""

ORDER = ("FASTER", "IDLE", "SLOWER", "LANE_LEFT", "LANE_RIGHT")
"""The order in which margins are computed; `DeadReckoning.order` leads from it to the world's actions."""


class Ego(NamedTuple):
    """The ego's motion, [...] each.

    Args:
        y: place across the road, in m.
        heading: rad.
        speed: m/s.
        target_lane: number of the lane that it steers to.
        target_speed: m/s.
        edge: the highest number that a lane may have, as far as it is known.
    """

    y: Tensor
    heading: Tensor
    speed: Tensor
    target_lane: Tensor
    target_speed: Tensor
    edge: Tensor


def stacked(ego: Ego) -> Tensor:
    """The fields of egos [N] as one tensor [N, 6], for the compiled loops; a copy without a gradient."""
    return torch.stack([one.detach().float().cpu() for one in ego], -1)


def _middle(low: Tensor, high: Tensor) -> Tensor:
    """The middle of intervals; of one that is open at an end, the other end."""
    return torch.where(low.isfinite(), low, high) / 2 + torch.where(high.isfinite(), high, low) / 2


class DeadReckoning:
    """Predicts the ego's motion from its actions, and corrects it where it contradicts the measurement.

    Args:
        kinematics: kinematics of the world's cars.
        period: seconds per decision.
        actions: names of the discrete actions.
        action_type: kind of the actions.
    """

    def __init__(
        self, kinematics: Kinematics, period: float, actions: tuple[str, ...], action_type: ActionType
    ) -> None:
        self.kinematics, self.dt, self.action_type = kinematics, period / kinematics.frames, action_type
        self.numbers = {name: number for number, name in enumerate(actions)}
        self.order = [ORDER.index(name) for name in actions] if action_type == "discrete" else []

    def unknown(self, episodes: Tensor) -> TensorDict:
        """The state before the first observation."""
        zero = torch.zeros(len(episodes), device=episodes.device)
        fields = dict.fromkeys(Ego._fields, zero)
        return TensorDict({**fields, "known": zero.bool()}, batch_size=episodes.shape)

    def now(self, boxes: Boxes, state: TensorDictBase) -> Ego:
        """The ego's motion at this observation: the prediction, moved into the measured row's box."""
        width, gained = self.kinematics.lane_width, state["known"]
        low, high = boxes.low[..., 0, :], boxes.high[..., 0, :]
        middle = _middle(low[..., 1], high[..., 1])
        first = (middle / width).round().clamp(min=0)
        begins, start, aimed = self._first(middle, first, _middle(low[..., 2], high[..., 2]))
        ego = Ego(*(state[name] for name in Ego._fields))
        missing = gained & (ego.y > high[..., 1] + OFF_THE_ROAD) & (ego.target_lane * width > high[..., 1])
        edge = torch.where(gained, torch.where(missing, ego.target_lane - 1, ego.edge), UNKNOWN_EDGE)
        y = torch.where(gained, torch.clamp(ego.y, low[..., 1] - SLACK, high[..., 1] + SLACK), begins)
        cos = ego.heading.cos()
        speed = torch.clamp(ego.speed * cos, low[..., 2] - SLACK, high[..., 2] + SLACK) / cos.clamp(min=0.1)
        return Ego(
            y=torch.where(missing, edge * width, y),
            heading=torch.where(missing, 0.0, ego.heading),
            speed=torch.where(gained, speed, start),
            target_lane=torch.where(gained, torch.minimum(ego.target_lane, edge), first),
            target_speed=torch.where(gained, ego.target_speed, aimed),
            edge=edge,
        )

    def _first(self, middle: Tensor, lane: Tensor, speed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Place across the road, speed and target speed [...] at the start, from what is measured then."""
        car = self.kinematics
        if car.start_speed is not None:
            start = torch.full_like(lane, car.start_speed)
            return lane * car.lane_width, start, start
        table = torch.tensor(car.target_speeds, dtype=speed.dtype, device=speed.device)
        return middle, speed, table[(speed[..., None] - table).abs().argmin(-1)]

    def after(self, ego: Ego, action: Tensor) -> TensorDict:
        """The state after an action, int64 [B] or float [B, 2]; without a gradient."""
        moved = stacked(ego)
        if self.action_type == "continuous":
            motion_kernels.steered(moved.numpy(), action.detach().float().cpu().contiguous().numpy(), self._car)
        else:
            orders, turns = self._changes[action.cpu()].unbind(-1)
            motion_kernels.driven(moved.numpy(), orders.numpy(), turns.numpy(), self._car)
        fields = dict(zip(Ego._fields, moved.T.contiguous().to(ego.y).unbind(0), strict=True))
        return TensorDict({**fields, "known": torch.ones_like(ego.y, dtype=torch.bool)}, batch_size=ego.y.shape)

    @cached_property
    def _changes(self) -> Tensor:
        """[A, 2] how each discrete action changes the target speed and the target lane."""
        changes = {"FASTER": (1, 0), "SLOWER": (-1, 0), "LANE_RIGHT": (0, 1), "LANE_LEFT": (0, -1)}
        return torch.tensor([changes.get(name, (0, 0)) for name in self.numbers])

    @cached_property
    def _car(self) -> motion_kernels.Car:
        """The kinematics as the compiled loops take them."""
        car = self.kinematics
        low, high, last = car.target_speeds[0], car.target_speeds[-1], len(car.target_speeds) - 1
        single = {
            "dt": self.dt,
            "half_length": car.length / 2,
            "lowest": low,
            "range": high - low,
            "spacing": (high - low) / last,
            **{
                name: getattr(car, name)
                for name in motion_kernels.Car._fields
                if hasattr(car, name) and name != "frames"
            },
        }
        return motion_kernels.Car(
            frames=car.frames, last=last, **{name: np.float32(value) for name, value in single.items()}
        )

    def commanded(self, ego: Ego, change: int) -> Tensor:
        """The target speed [...] after FASTER (`change` 1), SLOWER (-1) or another action (0)."""
        if change == 0:
            return ego.target_speed
        speeds = self.kinematics.target_speeds
        low, high, last = speeds[0], speeds[-1], len(speeds) - 1
        index = ((ego.speed - low) / (high - low) * last).round().clamp(0, last) + change
        return low + index.clamp(0, last) * ((high - low) / last)

    def speed_after(self, speed: Tensor, target: Tensor) -> Tensor:
        """The speed [...] in m/s after one decision towards the target speed [...]."""
        kept = (1 - self.kinematics.speed_gain * self.dt) ** self.kinematics.frames
        return target + (speed - target) * kept

    def steering(self, ego: Ego, place: Tensor) -> Tensor:
        """ControlledVehicle.steering_control: the steering angle [...] in rad towards a place across the road, in m."""
        car = self.kinematics
        speed = ego.speed.clamp(min=0.01)
        lateral = ego.y - place
        wanted = (-car.lateral_gain * lateral / speed).clamp(-1, 1).asin().clamp(-car.max_heading, car.max_heading)
        rate = car.heading_gain * (wanted - ego.heading)
        slip = (car.length / 2 / speed * rate).clamp(-1, 1).asin()
        return (2 * slip.tan()).atan().clamp(-car.max_steering, car.max_steering)
