"""The approach to a stop sign as a TorchRL environment, in closed loop: where the car is depends on how it brakes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded

from cavbench.detection import Scenes
from cavbench.detection.boxes import overlap
from cavbench.detection.closed_loop import STANDS_MPS, DrivingEnv, Plan
from cavbench.detection.stopping import REACTION_S, SPEED_MPS
from cavbench.envs.camera.braking import Brakes, Motion
from cavbench.envs.camera.cross_traffic import CrossTraffic
from cavbench.envs.camera.street.layout import CROSSING

TICK_S = 0.01
"""Time between two positions that are tested for a collision, rounded so that a step has a whole number of them."""
CAR_M = (4.6, 1.84)
"""Length and width of the car; its front is at the camera."""
CLEARED_M = -(CROSSING[1] + CAR_M[0])
"""Distance to the line at which the car has left the crossing."""


class ApproachEnv(DrivingEnv):
    """B cars that approach a stop sign, and brake or cross the road behind it, where the traffic brakes for them.

    The action is the deceleration that the driver asks for in m/s2, float32 [B, 1]. The brakes build it up
    (`cavbench.envs.camera.braking`). A car at 10 m/s drives from one frame to the next in a step. `observation` is the
    image of the nearest frame by distance, [B, 3, H, W]; after the last frame it stays the same. The stop line is level with
    the sign (`cavbench.detection.stopping`). An episode ends when the car stands still or has left the crossing road; a collision
    does not end it, because each car meets K draws of the cross traffic at once. The reward is 1 for stopping before the line,
    else 0.

    `info` has `distance` (from the front of the car to the line in m, negative beyond it), `speed` in m/s, `frame` (number of the
    frame), `shown` (its distance to the sign in m), the `box` of the sign in pixels [B, 4], and its `visible` share. It also has
    `others`, the rectangles of the cross traffic in m [B, K, N, 4], `hit`, whether the car has collided with one of them while it
    moved [B, K], and `braked`, whether one of them has braked [B, K].

    Args:
        scenes: frames of each approach, farthest first, all of one size and at the same distances.
        patches: sRGB in [0, 1], [B or 1, 3, P, P]; None for no patch.
        share: side of the patch as a share of the sign's side.
        speed: speed at the first frame in m/s.
        brakes: the brakes of the cars and of the cross traffic.
        reaction_s: reaction time of the cross traffic in s; inf if it does not react.
        seeds: seeds of K draws of the cross traffic; without any, the crossing road is empty.
        plan: the road from above, for films.
    """

    batch_locked = True

    def __init__(
        self,
        scenes: Sequence[Scenes],
        patches: Tensor | None = None,
        share: float = 0.5,
        *,
        speed: float = SPEED_MPS,
        brakes: Brakes = Brakes(),  # noqa: B008
        reaction_s: float = REACTION_S,
        seeds: Sequence[int] = (),
        plan: Plan = Plan(),  # noqa: B008
    ) -> None:
        super().__init__(device="cpu", batch_size=torch.Size([len(scenes)]))
        self.scenes, self.share, self.approach_speed, self.brakes = tuple(scenes), share, speed, brakes
        self.patches = None if patches is None else patches.expand(len(scenes), -1, -1, -1)
        self.plan, self.reaction_s = plan, reaction_s
        batch = len(scenes)
        self.begun = self.traffic = CrossTraffic.drawn(seeds, batch)
        self.distances = self.scenes[0].distance
        self.step_s = float(-self.distances.diff().max()) / SPEED_MPS
        width = self.scenes[0].boxes[:, 2] - self.scenes[0].boxes[:, 0]
        # The median: a box at the edge of the image is cut off.
        self.sign_px_m = float((width * self.distances).median())
        self._pictures: list[tuple[int, Tensor] | None] = [None] * batch
        """The number of the frame that each car saw last, and its image: while a car is near one frame, it is rendered once."""
        self.motion = Motion(*(torch.zeros(batch) for _ in range(3)))
        self.hit = torch.zeros(batch, len(seeds), dtype=torch.bool)
        number = Unbounded(shape=(batch, 1), dtype=torch.float32)
        info = Composite(
            distance=number,
            speed=number.clone(),
            frame=Categorical(len(self.distances), shape=(batch, 1), dtype=torch.int64),
            shown=number.clone(),
            box=Unbounded(shape=(batch, 4), dtype=torch.float32),
            visible=Bounded(0, 1, shape=(batch, 1), dtype=torch.float32),
            others=Unbounded(shape=(*self.traffic.motion.speed.shape, 4), dtype=torch.float32),
            hit=Binary(shape=(batch, len(seeds)), dtype=torch.bool),
            braked=Binary(shape=(batch, len(seeds)), dtype=torch.bool),
            shape=(batch,),
        )
        picture = Bounded(0, 1, shape=(batch, 3, *self.scenes[0].size), dtype=torch.float32)
        self.observation_spec = Composite(observation=picture, info=info, shape=(batch,))
        self.action_spec = Bounded(0, brakes.greatest, shape=(batch, 1), dtype=torch.float32)
        self.reward_spec = number.clone()
        flag = Binary(1, shape=(batch, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), shape=(batch,))

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random: an approach is given by its frames, and the cross traffic by its seeds."""

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        chosen = torch.ones(self.batch_size, dtype=torch.bool) if mask is None else mask.view(-1)
        still = torch.zeros(self.batch_size)
        begin = Motion(still + self.distances[0], still + self.approach_speed, still)
        self.motion = begin.where(chosen, self.motion)
        self.traffic = self.begun.where(chosen, self.traffic)
        self.hit = self.hit & ~chosen[:, None]
        return self._shown()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        running = ~self._ended()
        asked = tensordict["action"][:, 0]
        ticks = max(1, round(self.step_s / TICK_S))
        for _ in range(ticks):
            moves, tick_s = ~self._ended(), self.step_s / ticks
            later = self.traffic.moved(self.motion, CAR_M, self.brakes, self.reaction_s, tick_s)
            self.traffic = later.where(moves, self.traffic)
            self.motion = self.brakes.moved(self.motion, asked, tick_s).where(moves, self.motion)
            self.hit = self.hit | (self._collided() & moves[:, None])
        stopped = running & (self.motion.speed <= STANDS_MPS) & (self.motion.distance >= 0)
        return self._shown().set("reward", stopped[:, None].float())

    def _ended(self) -> Tensor:
        return (self.motion.speed <= STANDS_MPS) | (self.motion.distance < CLEARED_M)

    def _collided(self) -> Tensor:
        """Whether each car overlaps a vehicle in each draw, [B, K]."""
        front, half = -self.motion.distance, torch.full_like(self.motion.distance, CAR_M[1] / 2)
        car = torch.stack([-half, front - CAR_M[0], half, front], -1)
        return (overlap(car[:, None, None], self.traffic.rectangles()) > 0).any(-1)

    def _shown(self) -> TensorDict:
        frames = (self.motion.distance[:, None] - self.distances).abs().argmin(-1)
        pictures, boxes, visible = [], [], []
        for number, (scenes, frame) in enumerate(zip(self.scenes, frames, strict=True)):
            pictures.append(self._picture(number, int(frame)))
            boxes.append(scenes.boxes[frame])
            visible.append(scenes.visible[frame].view(1))
        ended = self._ended()[:, None]
        info = {
            "distance": self.motion.distance[:, None].clone(),
            "speed": self.motion.speed[:, None].clone(),
            "frame": frames[:, None],
            "shown": self.distances[frames][:, None],
            "box": torch.stack(boxes),
            "visible": torch.stack(visible),
            "others": self.traffic.rectangles(),
            "hit": self.hit.clone(),
            "braked": self.traffic.braked,
        }
        content = {
            "observation": torch.stack(pictures),
            "info": TensorDict(info, batch_size=self.batch_size),
            "done": ended,
            "terminated": ended.clone(),
        }
        return TensorDict(content, batch_size=self.batch_size)

    def _picture(self, number: int, frame: int) -> Tensor:
        """The image [3, H, W] of a frame, as a car sees it."""
        last = self._pictures[number]
        if last is None or last[0] != frame:
            patch = None if self.patches is None else self.patches[number : number + 1]
            shown = self.scenes[number].render(torch.tensor([frame]), patch, self.share)[0]
            self._pictures[number] = last = (frame, shown.detach())
        return last[1]
