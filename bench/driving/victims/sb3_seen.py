"""What stands between a world and a policy of Stable-Baselines3: the statistics of `VecNormalize`, and stacks of frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from cavbench import bounded
from cavbench.driving.victims.remembering import BEGUN, Memory
from cavbench.driving.victims.spaces import Bounds
from cavbench.errors import UserError
from cavbench.formats import pickled

Layout = Literal["last", "first", "new"]
STATISTICS = "stable_baselines3.common.vec_env.vec_normalize.VecNormalize"
LARGEST = 2**24
"""Bytes that a file of statistics may have."""


class Normaliser(nn.Module):
    """Observations as `VecNormalize` shows them.

    Args:
        mean, variance: of each entry of an observation.
        epsilon: is added to the variance.
        clip: largest absolute value of the result.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, mean: Any, variance: Any, epsilon: float, clip: float) -> None:
        super().__init__()
        self.shape, self.clip = tuple(np.shape(mean)), clip
        # In float64, as there: a feature that hardly varies is divided by almost nothing.
        self.register_buffer("mean", torch.as_tensor(np.array(mean, np.float64)))
        self.register_buffer("deviation", (torch.as_tensor(np.array(variance, np.float64)) + epsilon).sqrt())

    def forward(self, observation: Tensor) -> Tensor:
        shown = (observation.double() - self.mean) / self.deviation
        return shown.clamp(-self.clip, self.clip).to(observation.dtype)

    # A network is made float32 as a whole; the statistics stay what they are.
    def _apply(self, fn: Any, recurse: bool = True) -> Normaliser:
        super()._apply(fn, recurse)
        self.mean, self.deviation = self.mean.double(), self.deviation.double()
        return self


def statistics(given: str) -> Normaliser | None:
    """The statistics in the file of `VecNormalize.save`, which is a pickle and is read as data; None if it leaves observations.

    Args:
        given: path of the file.

    Raises:
        UserError: if it is no such file.
    """
    path = Path(given).expanduser()
    if not path.exists():
        raise UserError(f"there is no file {given}; set victim.normalize=… to the file of VecNormalize.save")
    content = bounded.content(path, most=LARGEST, name=given)
    damaged = UserError(
        f"{given} cannot be read: it is not a file of Stable-Baselines3's VecNormalize.save, or a damaged one"
    )
    try:
        saved = pickled.read(content)
    except ValueError as error:
        raise damaged from error
    if not isinstance(saved, pickled.Made) or saved.name != STATISTICS or not isinstance(saved.state, dict):
        raise damaged
    if saved.state.get("norm_obs") is False:
        return None
    found: Any = saved.state.get("obs_rms")
    if isinstance(found, dict):
        raise UserError(f"{given} normalises a Dict of observations; the type must be Box")
    try:
        mean, variance = (pickled.array(found.state[name]) for name in ("mean", "var"))
        clip, epsilon = float(saved.state["clip_obs"]), float(saved.state["epsilon"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise damaged from error
    if mean is None or variance is None or mean.shape != variance.shape or not mean.size:
        raise damaged
    if not (
        np.isfinite(mean).all() and np.isfinite(variance).all() and (variance >= 0).all() and clip > 0 and epsilon > 0
    ):
        raise UserError(f"{given} has statistics that are not finite, or a negative variance")
    return Normaliser(mean, variance, epsilon, clip)


@dataclass(frozen=True, kw_only=True)
class Stack:
    """A stack of frames.

    Args:
        frames: number of them, the newest last.
        layout: `last`: side by side along the last axis; `first`: along the first; `new`: along a new first axis.
        zero: whether frames before the first are 0 (`VecFrameStack`), or copies of the first (gymnasium's default).
    """

    frames: int
    layout: Layout
    zero: bool

    @classmethod
    def of(cls, frames: int, shape: Sequence[int], one: tuple[int | None, ...]) -> Stack:
        """The stack of a policy that takes observations `shape` in a world that shows `one`.

        Raises:
            ValueError: if it is none.
        """
        single = tuple(side or 0 for side in one)
        stacked = tuple(shape)
        if stacked in ((frames, *single), (frames, math.prod(single))):
            return cls(frames=frames, layout="new", zero=False)
        if stacked in ((*single[:-1], frames * single[-1]), (frames * math.prod(single),)):
            return cls(frames=frames, layout="last", zero=True)
        if stacked == (frames * single[0], *single[1:]):
            return cls(frames=frames, layout="first", zero=True)
        raise ValueError

    def single(self, shape: Sequence[int]) -> tuple[int, ...]:
        """The shape of a frame.

        Raises:
            ValueError: if the shape is not one of so many frames.
        """
        axis = -1 if self.layout == "last" else 0
        if shape[axis] % self.frames or (self.layout == "new" and shape[0] != self.frames):
            raise ValueError
        sides = list(shape)
        sides[axis] //= self.frames
        return tuple(sides[1:] if self.layout == "new" else sides)

    def newest(self, stacked: Any) -> Any:
        """The newest frame of arrays [n, *shape]."""
        if self.layout == "new":
            return stacked[:, -1]
        axis = stacked.ndim - 1 if self.layout == "last" else 1
        return np.split(stacked, self.frames, axis)[-1]

    def frame(self, rows: Any, shape: Sequence[int]) -> Any:
        """The newest frame of flattened observations [n, entries], flattened."""
        return self.newest(rows.reshape(-1, *shape)).reshape(len(rows), -1)

    def bounds(self, bounds: Bounds) -> Bounds:
        """The space of a frame.

        Raises:
            ValueError: if the frames differ.
        """
        shape = self.single(bounds.shape)
        sides = []
        for side in (bounds.low, bounds.high):
            array = np.array(side if len(side) > 1 else side * math.prod(bounds.shape)).reshape(1, *bounds.shape)
            frame = self.newest(array)
            if not np.array_equal(self.together(torch.from_numpy(np.stack([frame] * self.frames, 1))).numpy(), array):
                raise ValueError
            numbers = tuple(float(number) for number in frame.reshape(-1))
            sides.append(numbers[:1] if len(set(numbers)) == 1 else numbers)
        return Bounds(shape=shape, low=sides[0], high=sides[1])

    def together(self, frames: Tensor) -> Tensor:
        """Frames [N, frames, *single] as the policy takes them."""
        if self.layout == "new":
            return frames
        return torch.cat(frames.unbind(1), -1 if self.layout == "last" else 1)


class Stacked(nn.Module):
    """A network on stacks of frames, as one that remembers the earlier frames (`RememberingPolicy`).

    Args:
        network: maps stacks of observations to its answer.
        stack: the stack.
        shape: shape of a frame.
        before: normalises a frame, before it is put on the stack; None leaves it.
    """

    def __init__(
        self, network: nn.Module, stack: Stack, shape: Sequence[int], before: Normaliser | None = None
    ) -> None:
        super().__init__()
        self.network, self.stack, self.shape, self.before = network, stack, tuple(shape), before

    @property
    def memory(self) -> Memory:
        return {BEGUN: ((), torch.bool), "frames": ((self.stack.frames - 1, *self.shape), torch.float32)}

    def forward(self, observation: Tensor, memory: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        newest = (observation if self.before is None else self.before(observation)).unsqueeze(1)
        earlier, begun = memory["frames"], memory[BEGUN]
        if not self.stack.zero:
            earlier = torch.where(begun.view(-1, *[1] * (newest.ndim - 1)), earlier, newest.expand_as(earlier))
        frames = torch.cat((earlier, newest), 1)
        answer = self.network(self.stack.together(frames))
        entries = {BEGUN: torch.ones_like(begun), "frames": frames[:, 1:]}
        return answer, TensorDict(entries, batch_size=observation.shape[:1])
