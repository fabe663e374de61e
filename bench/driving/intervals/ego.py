"""Dead reckoning: the ego's own motion, from the actions that it has taken. They cannot be forged."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.driving.features import ActionType
from cavbench.driving.intervals import motion_kernels
from cavbench.driving.intervals.boxes import Assumed, Boxes, flat
from cavbench.driving.intervals.motion_kernels import OFF_THE_ROAD, SLACK, UNKNOWN_EDGE
from cavbench.driving.kinematics import Kinematics

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


class Step(NamedTuple):
    """A decision of the ego.

    Args:
        now: its motion before.
        after: its state after it, [B, 7].
    """

    now: Ego
    after: Tensor


def stacked(ego: Ego) -> Tensor:
    """The fields of egos [N] as one tensor [N, 6], for the compiled loops; a copy without a gradient."""
    return torch.stack(tuple(ego), -1).detach().float().cpu()


def reckoned(ego: Ego, known: Tensor) -> Tensor:
    """Egos [...] as a state [..., 7]: the fields, and 1 where the ego is `known`, bool [...], else 0."""
    return torch.stack((*ego, known.to(ego.y)), -1)


def fields(state: Tensor) -> tuple[Ego, Tensor]:
    """The egos [...] of a state [..., 7], and whether they are known, bool [...]."""
    *ego, known = state.unbind(-1)
    return Ego(*ego), known > 0


def predicted(state: Tensor) -> tuple[NDArray[Any], NDArray[Any]]:
    """A state of N episodes for the compiled loops, [N, 7], with the cosines and sines of the headings, [N, 2].

    These are torch's own functions: those of the compiled code may differ in the last bit.
    """
    egos = flat(state, 1)
    heading = torch.from_numpy(egos[:, motion_kernels.HEADING])
    turned = np.empty((len(egos), 2), np.float32)
    turned[:, 0], turned[:, 1] = heading.cos().numpy(), heading.sin().numpy()
    return egos, turned


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

    def unknown(self, episodes: Tensor) -> Tensor:
        """The state before the first observation, as of `reckoned`, [B, 7]."""
        return torch.zeros(len(episodes), 1 + len(Ego._fields), device=episodes.device)

    def boxes(self, assumed: Assumed, shown: Tensor, state: Tensor, tracks: Tensor | None = None) -> Boxes:
        """The true values behind a shown observation [..., V, F], as of `Assumed.boxes`, in the frame of the road.

        Args:
            assumed: the perturbation set.
            shown: the observation.
            state: the reckoned ego.
            tracks: what `tracks.predicted` gave for the same episodes.
        """
        return assumed.boxes(shown, tracks)

    def middles(self, boxes: Boxes, rows: int) -> Tensor:
        """The middles of the boxes of the shown rows, in the frame of the world, [..., V, F - 1]."""
        return (boxes.low + boxes.high) / 2

    def corrected(self, observation: Tensor, ego: Ego, boxes: Boxes, assumed: Assumed) -> Tensor:
        """The observation [..., V, F] with the reckoned y, vx and vy in the ego's row."""
        along, across = ego.speed * ego.heading.cos(), ego.speed * ego.heading.sin()
        own = assumed.normalised(torch.stack([torch.zeros_like(along), ego.y, along, across], -1))[..., 1:]
        row = torch.cat((observation[..., :1, :2], own.unsqueeze(-2)), -1)
        return torch.cat((row, observation[..., 1:, :]), -2)

    def now(self, boxes: Boxes, state: Tensor) -> Ego:
        """The ego's motion at this observation: the prediction, moved into the measured row's box."""
        width, (ego, gained) = self.kinematics.lane_width, fields(state)
        low, high = boxes.low[..., 0, :], boxes.high[..., 0, :]
        middle = _middle(low[..., 1], high[..., 1])
        first = (middle / width).round().clamp(min=0)
        begins, start, aimed = self._first(middle, first, _middle(low[..., 2], high[..., 2]))
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

    def after(self, ego: Ego, action: Tensor) -> Tensor:
        """The state [B, 7] after an action, int64 [B] or float [B, 2]; without a gradient."""
        return self._after(stacked(ego).numpy(), action, ego.y)

    def step(self, boxes: Boxes, state: Tensor, action: Tensor) -> Step:
        """`now`, and the state `after` an action; without a gradient, in one pass."""
        egos = np.empty((len(boxes.low), len(Ego._fields)), np.float32)
        motion_kernels.reckon(*predicted(state), flat(boxes.low, 2), flat(boxes.high, 2), self.car, egos)
        now = Ego(*torch.from_numpy(egos.T.copy()).to(boxes.low).unbind(0))
        return Step(now, self._after(egos, action, boxes.low))

    def _after(self, egos: NDArray[Any], action: Tensor, like: Tensor) -> Tensor:
        """The state after an action; moves the egos [B, 6]."""
        if self.action_type == "continuous":
            motion_kernels.steered(egos, action.detach().float().cpu().contiguous().numpy(), self.car)
        else:
            orders, turns = self._changes[:, action.cpu()].numpy()
            motion_kernels.driven(egos, orders, turns, self.car)
        return torch.nn.functional.pad(torch.from_numpy(egos), (0, 1), value=1.0).to(like)

    @cached_property
    def _changes(self) -> Tensor:
        """[2, A] how each discrete action changes the target speed and the target lane."""
        changes = {"FASTER": (1, 0), "SLOWER": (-1, 0), "LANE_RIGHT": (0, 1), "LANE_LEFT": (0, -1)}
        return torch.tensor([changes.get(name, (0, 0)) for name in self.numbers]).T.contiguous()

    @cached_property
    def car(self) -> motion_kernels.Car:
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
        return target + (speed - target) * self.kept

    @property
    def kept(self) -> float:
        """The share of the difference to the target speed that is left after one decision."""
        return (1 - self.kinematics.speed_gain * self.dt) ** self.kinematics.frames

    def steering(self, ego: Ego, place: Tensor) -> Tensor:
        """ControlledVehicle.steering_control: the steering angle [...] in rad towards a place across the road, in m."""
        car = self.kinematics
        speed = ego.speed.clamp(min=0.01)
        lateral = ego.y - place
        wanted = (-car.lateral_gain * lateral / speed).clamp(-1, 1).asin().clamp(-car.max_heading, car.max_heading)
        rate = car.heading_gain * (wanted - ego.heading)
        slip = (car.length / 2 / speed * rate).clamp(-1, 1).asin()
        return (2 * slip.tan()).atan().clamp(-car.max_steering, car.max_steering)
