"""The closed loop: a detector drives a car up to the sign frame by frame, and the car stops or does not."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torchrl.envs import EnvBase

from cavbench.detection import stopping
from cavbench.detection.boxes import overlap
from cavbench.detection.detector import Detections, Detector
from cavbench.detection.driver import Memory
from cavbench.detection.sight import SAME_IOU, Sight, glance

STANDS_MPS = 1e-3
"""A slower car stands still."""
ROUNDING_M = 1e-3
"""Smaller overruns are rounding errors."""
MOST_STEPS = 2_000
"""A drive is cut after this many steps; a car that drives on has left the crossing long before."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Plan:
    """The road from above, for films; rectangles are x0, y0, x1, y1 in m, with the line at y = 0 and the car driving towards +y.

    Args:
        roads: [R, 4].
        lines: [L, 4], painted lines.
        sign: x and y of the stop sign.
        waiting: [W, 4], vehicles that stand at the line.
        car: length and width of the car, whose front is at its distance to the line.
    """

    roads: Array = field(default_factory=lambda: np.zeros((0, 4)))
    lines: Array = field(default_factory=lambda: np.zeros((0, 4)))
    sign: tuple[float, float] = (0.0, 0.0)
    waiting: Array = field(default_factory=lambda: np.zeros((0, 4)))
    car: tuple[float, float] = (4.6, 1.84)


class DrivingEnv(EnvBase):
    """An environment of cars that a detector can drive; `cavbench.envs.camera.environment.ApproachEnv` says what it shows.

    Args:
        step_s: time of a step in s.
        sign_px_m: width of a stop sign in the image times its distance, in pixels times m: focal length times the sign's width.
        plan: the road from above.
    """

    step_s: float
    sign_px_m: float
    plan: Plan


@dataclass(frozen=True)
class Moment:
    """A step of a drive.

    Args:
        distance_m: from the front of the car to the line; negative beyond it.
        speed_mps: of the car.
        frame: number of the frame that was shown.
        confidence: in the sign at its true place.
        found: the stop signs that were detected.
        confirmed: whether the driver has confirmed a sign, there or elsewhere.
        asked: deceleration that the driver asks for, in m/s2.
        others: rectangles [N, 4] of the cross traffic in m, in the draws that are kept.
        hit: [K], whether the car has collided.
        braked: [K], whether a vehicle of the cross traffic has braked.
    """

    distance_m: float
    speed_mps: float
    frame: int
    confidence: float
    found: Detections
    confirmed: bool
    asked: float
    others: Mapping[int, Array]
    hit: NDArray[np.bool_]
    braked: NDArray[np.bool_]


@dataclass(frozen=True)
class Drive:
    """A drive of one car, with K draws of the cross traffic.

    Args:
        moments: its steps.
        step_s: time between two steps.
        confirmed_m: distance at which the sign was confirmed; 0 if it never was.
        false_m: distance at which something else was first confirmed as a stop sign; 0 if nothing was.
    """

    moments: tuple[Moment, ...]
    step_s: float
    confirmed_m: float
    false_m: float

    @property
    def stands(self) -> bool:
        """Whether it stood still at the end."""
        return self.moments[-1].speed_mps <= STANDS_MPS

    @property
    def overrun_m(self) -> float:
        """How far beyond the line the car came until it stood still or had left the crossing; 0 if it stopped before the line."""
        beyond = -self.moments[-1].distance_m
        return beyond if beyond > ROUNDING_M else 0.0

    @property
    def short_m(self) -> float:
        """How far before the line the car stood still; 0 if it stood at or beyond the line, or did not stop."""
        before = self.moments[-1].distance_m
        return before if self.stands and before > ROUNDING_M else 0.0

    @property
    def stopped(self) -> bool:
        """Whether it stopped at the line: at most `stopping.RAN_M` beyond it and at most `stopping.EARLY_M` before it."""
        return self.stands and self.overrun_m <= stopping.RAN_M and self.short_m <= stopping.EARLY_M

    @property
    def collided(self) -> NDArray[np.bool_]:
        """[K] whether it collided in each draw."""
        return self.moments[-1].hit

    @property
    def braked(self) -> NDArray[np.bool_]:
        """[K] whether the cross traffic braked in each draw."""
        return self.moments[-1].braked


@dataclass(frozen=True)
class Drives:
    """The drives of one approach, for films.

    Args:
        shown: the drive that was scored.
        clean: the same without the patch; None if there is no patch.
        draw: number of the approach's draw of the cross traffic.
        plan: the road from above.
    """

    shown: Drive
    clean: Drive | None
    draw: int
    plan: Plan


@torch.no_grad()
def drive(
    detector: Detector, env: DrivingEnv, draws: Sequence[int] = (), seen: MutableMapping[str, Sight] | None = None
) -> Drive:
    """Let a detector drive the car of an environment of one car (`CameraWorld.environment`) until its episode ends.

    Each new frame is shown to the detector, with the distance driven since the one before. The stop signs that it detects go to
    the driver (`cavbench.detection.driver`), and the deceleration that the driver asks for goes to the car.

    Args:
        detector: the (defended) victim.
        env: the environment.
        draws: numbers of the draws of the cross traffic whose positions are kept.
        seen: what the detector saw in other drives, by what was shown; it grows. A frame in it is not looked at again, unless the
            detector has a memory.

    Raises:
        UserError: if a prediction is NaN or infinite.
        ValueError: if the environment has several cars.
    """
    (batch,) = env.batch_size
    if batch != 1:
        raise ValueError(f"a drive is that of one car, got {batch}")
    memory, sight, now = Memory(env.sign_px_m), None, env.reset()
    remembered, looked_at = detector.initial(), now["info"]["distance"][:, 0]
    start_m, confirmed_m, false_m = float(looked_at), 0.0, 0.0
    moments: list[Moment] = []
    shared = None if detector.remembers else seen
    while len(moments) < MOST_STEPS:
        info = now["info"]
        distance, speed, frame = float(info["distance"]), float(info["speed"]), int(info["frame"])
        driven = start_m - distance
        if sight is None or frame != memory.frame:
            moved, looked_at = looked_at - info["distance"][:, 0], info["distance"][:, 0]
            key = "" if shared is None else _shown(now["observation"], info["box"])
            if shared is not None and key in shared:
                sight = shared[key]
            else:
                sight, remembered = glance(detector, now["observation"], info["box"], moved, remembered)
            if shared is not None:
                shared[key] = sight
            known = len(memory.confirmed)
            # The image is of the nearest frame, not of the place of the car.
            memory = memory.seeing(sight.found[0].boxes, frame, start_m - float(info["shown"]))
            if distance > 0 and len(memory.confirmed) > known:
                for track in memory.confirmed:
                    is_sign = float(overlap(track.box, info["box"][0])) >= SAME_IOU
                    fresh = track.since_s == 0
                    confirmed_m = confirmed_m or distance * (fresh and is_sign)
                    false_m = false_m or distance * (fresh and not is_sign)
        asked, memory = memory.deciding(driven, speed)
        moments.append(
            Moment(
                distance_m=distance,
                speed_mps=speed,
                frame=frame,
                confidence=float(sight.confidence[0]),
                found=sight.found[0],
                confirmed=bool(memory.confirmed),
                asked=asked,
                others={draw: info["others"][0, draw].double().numpy() for draw in draws},
                hit=info["hit"][0].numpy(),
                braked=info["braked"][0].numpy(),
            )
        )
        if bool(now["done"].all()):
            break
        now = env.step(now.set("action", env.action_spec.project(torch.tensor([[asked]]))))["next"]
        memory = memory.after(env.step_s)
    return Drive(tuple(moments), env.step_s, confirmed_m, false_m)


def _shown(picture: torch.Tensor, box: torch.Tensor) -> str:
    """Equal for frames with the same pixels and the same box of the sign."""
    return hashlib.sha256(picture.numpy().tobytes() + box.numpy().tobytes()).hexdigest()


MEASURED = (
    "stopped",
    "drive_confirmed_m",
    "drive_overrun_m",
    "collided",
    "drive_short_m",
    "drive_false_m",
    "others_braked",
)
"""The columns of a drive."""


def measured(driven: Drive | None, approaches: int) -> dict[str, NDArray[np.generic]]:
    """The columns of a drive [A], one row for each approach and its draw of the cross traffic; NaN without a closed loop."""
    if driven is None:
        return {name: np.full(approaches, np.nan) for name in MEASURED}
    return {
        "stopped": np.array([driven.stopped] * approaches),
        "drive_confirmed_m": np.array([driven.confirmed_m] * approaches),
        "drive_overrun_m": np.array([driven.overrun_m] * approaches),
        "collided": driven.collided,
        "drive_short_m": np.array([driven.short_m] * approaches),
        "drive_false_m": np.array([driven.false_m] * approaches),
        "others_braked": driven.braked,
    }
