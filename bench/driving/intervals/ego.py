"""Dead reckoning: the ego's own motion, from the actions that it has taken. They cannot be forged."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench.driving.features import ActionType
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
        middle = torch.where(low[..., 1].isfinite(), low[..., 1], high[..., 1]) / 2
        middle = middle + torch.where(high[..., 1].isfinite(), high[..., 1], low[..., 1]) / 2
        first = (middle / width).round().clamp(min=0)
        start = torch.full_like(first, self.kinematics.start_speed)
        ego = Ego(*(state[name] for name in Ego._fields))
        missing = gained & (ego.y > high[..., 1] + OFF_THE_ROAD) & (ego.target_lane * width > high[..., 1])
        edge = torch.where(gained, torch.where(missing, ego.target_lane - 1, ego.edge), UNKNOWN_EDGE)
        y = torch.where(gained, torch.clamp(ego.y, low[..., 1] - SLACK, high[..., 1] + SLACK), first * width)
        cos = ego.heading.cos()
        speed = torch.clamp(ego.speed * cos, low[..., 2] - SLACK, high[..., 2] + SLACK) / cos.clamp(min=0.1)
        return Ego(
            y=torch.where(missing, edge * width, y),
            heading=torch.where(missing, 0.0, ego.heading),
            speed=torch.where(gained, speed, start),
            target_lane=torch.where(gained, torch.minimum(ego.target_lane, edge), first),
            target_speed=torch.where(gained, ego.target_speed, start),
            edge=edge,
        )

    def after(self, ego: Ego, action: Tensor) -> TensorDict:
        """The state after an action, int64 [B] or float [B, 2]."""
        moved = self._steered(ego, action) if self.action_type == "continuous" else self._driven(ego, action)
        return TensorDict(
            {**moved._asdict(), "known": torch.ones_like(ego.y, dtype=torch.bool)}, batch_size=ego.y.shape
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

    def _driven(self, ego: Ego, action: Tensor) -> Ego:
        target, lane = ego.target_speed, ego.target_lane
        for name, change in (("FASTER", 1), ("SLOWER", -1)):
            target = torch.where(action == self.numbers[name], self.commanded(ego, change), target)
        for name, change in (("LANE_RIGHT", 1), ("LANE_LEFT", -1)):
            lane = torch.where(action == self.numbers[name], lane + change, lane)
        lane = torch.minimum(lane.clamp(min=0), ego.edge)
        width = self.kinematics.lane_width
        # A lane farther away than two lane widths cannot be chosen (highway-env's AbstractLane.is_reachable_from).
        lane = torch.where((ego.y - width * lane).abs() <= 2 * width, lane, ego.target_lane)
        ego = ego._replace(target_lane=lane, target_speed=target)
        for _ in range(self.kinematics.frames):
            gain = self.kinematics.speed_gain
            ego = self._moved(ego, gain * (target - ego.speed), self._steering(ego))
        return ego

    def _steered(self, ego: Ego, action: Tensor) -> Ego:
        limits = self.kinematics
        action = action.clamp(-1, 1)
        for _ in range(limits.frames):
            ego = self._moved(ego, action[..., 0] * limits.acceleration_limit, action[..., 1] * limits.steering_limit)
        return ego._replace(target_lane=torch.minimum((ego.y / limits.lane_width).round().clamp(min=0), ego.edge))

    def _steering(self, ego: Ego) -> Tensor:
        """The steering angle in rad towards the middle of the target lane."""
        return self.steering(ego, self.kinematics.lane_width * ego.target_lane)

    def steering(self, ego: Ego, place: Tensor) -> Tensor:
        """ControlledVehicle.steering_control: the steering angle [...] in rad towards a place across the road, in m."""
        car = self.kinematics
        speed = ego.speed.clamp(min=0.01)
        lateral = ego.y - place
        wanted = (-car.lateral_gain * lateral / speed).clamp(-1, 1).asin().clamp(-car.max_heading, car.max_heading)
        rate = car.heading_gain * (wanted - ego.heading)
        slip = (car.length / 2 / speed * rate).clamp(-1, 1).asin()
        return (2 * slip.tan()).atan().clamp(-car.max_steering, car.max_steering)

    def _moved(self, ego: Ego, acceleration: Tensor, steering: Tensor) -> Ego:
        """Vehicle.step: one frame of the kinematic bicycle model."""
        # Vehicle.clip_actions
        excess = ego.speed - self.kinematics.top_speed
        acceleration = torch.where(excess > 0, torch.minimum(acceleration, -excess), acceleration)
        slip = (0.5 * steering.tan()).atan()
        y = ego.y + ego.speed * (ego.heading + slip).sin() * self.dt
        heading = ego.heading + ego.speed * slip.sin() / (self.kinematics.length / 2) * self.dt
        return ego._replace(y=y, heading=heading, speed=ego.speed + acceleration * self.dt)
