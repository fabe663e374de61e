"""The camera world as a TorchRL environment: the driver can brake during an approach."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from bench.detection import Scenes
from bench.detection.stopping import SPEED_MPS

HARDEST_MPS2 = 8.0
"""Full braking on a dry road."""


class ApproachEnv(EnvBase):
    """B cars that approach a stop sign at 10 m/s.

    The action is the deceleration in m/s2, float32 [B, 1] in [0, 8]. A step is the time in which a car that does not brake
    drives from one frame to the next. `observation` is the image of the nearest frame by distance, [B, 3, H, W]; after the
    last frame it stays the same. `info` has the `distance` to the sign in m, the `speed` in m/s, the `box` of the sign in
    pixels [B, 4] and its `visible` share. An episode ends when the car stands still or passes the sign; the stop line is level
    with it (`bench.detection.stopping`). The reward is 1 for stopping before the line, else 0.

    Args:
        scenes: frames of each approach, farthest first, all of one size and at the same distances.
        patches: sRGB in [0, 1], [B or 1, 3, P, P]; None for no patch.
        share: side of the patch as a share of the sign's side.
    """

    batch_locked = True

    def __init__(self, scenes: Sequence[Scenes], patches: Tensor | None = None, share: float = 0.5) -> None:
        super().__init__(device="cpu", batch_size=torch.Size([len(scenes)]))
        self.scenes, self.share = tuple(scenes), share
        self.patches = None if patches is None else patches.expand(len(scenes), -1, -1, -1)
        self.distances = self.scenes[0].distance
        self.step_s = float(self.distances[0] - self.distances[1]) / SPEED_MPS
        self.distance = self.speed = torch.zeros(len(scenes), 1)
        batch = len(scenes)
        number = Unbounded(shape=(batch, 1), dtype=torch.float32)
        info = Composite(
            distance=number,
            speed=number.clone(),
            box=Unbounded(shape=(batch, 4), dtype=torch.float32),
            visible=Bounded(0, 1, shape=(batch, 1), dtype=torch.float32),
            shape=(batch,),
        )
        picture = Bounded(0, 1, shape=(batch, 3, *self.scenes[0].size), dtype=torch.float32)
        self.observation_spec = Composite(observation=picture, info=info, shape=(batch,))
        self.action_spec = Bounded(0, HARDEST_MPS2, shape=(batch, 1), dtype=torch.float32)
        self.reward_spec = number.clone()
        flag = Binary(1, shape=(batch, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), shape=(batch,))

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random: an approach is given by its frames."""

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        chosen = torch.ones(*self.batch_size, 1, dtype=torch.bool) if mask is None else mask.view(-1, 1)
        self.distance = torch.where(chosen, self.distances[0], self.distance)
        self.speed = torch.where(chosen, SPEED_MPS, self.speed)
        return self._shown()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        running = ~self._ended()
        braking = tensordict["action"].clamp(0, HARDEST_MPS2)
        # A car that stops within the step does not move backwards.
        seconds = torch.where(braking > 0, (self.speed / braking.clamp(min=1e-6)).clamp(max=self.step_s), self.step_s)
        driven = self.speed * seconds - braking * seconds.square() / 2
        self.distance = torch.where(running, self.distance - driven, self.distance)
        self.speed = torch.where(running, (self.speed - braking * seconds).clamp(min=0), self.speed)
        stopped = running & (self.speed <= 1e-4) & (self.distance >= 0)
        return self._shown().set("reward", stopped.float())

    def _ended(self) -> Tensor:
        return (self.speed <= 1e-4) | (self.distance < 0)

    def _shown(self) -> TensorDict:
        frames = (self.distance - self.distances).abs().argmin(-1)
        pictures, boxes, visible = [], [], []
        for number, (scenes, frame) in enumerate(zip(self.scenes, frames, strict=True)):
            patch = None if self.patches is None else self.patches[number : number + 1]
            pictures.append(scenes.render(frame.view(1), patch, self.share)[0])
            boxes.append(scenes.boxes[frame])
            visible.append(scenes.visible[frame].view(1))
        ended = self._ended()
        info = {"distance": self.distance.clone(), "speed": self.speed.clone()}
        info |= {"box": torch.stack(boxes), "visible": torch.stack(visible)}
        content = {
            "observation": torch.stack(pictures).detach(),
            "info": TensorDict(info, batch_size=self.batch_size),
            "done": ended,
            "terminated": ended.clone(),
        }
        return TensorDict(content, batch_size=self.batch_size)
