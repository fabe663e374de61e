"""Minimal third-party plug-ins of the detection track: red squares, a detector of red, attacks that misbehave on demand."""

from __future__ import annotations

import os
import signal
import time
from copy import copy
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from cavbench import zoo
from cavbench.core.contracts import Access, Facts, Progress, Trained
from cavbench.detection import (
    Approach,
    CameraWorld,
    Decoy,
    Detector,
    DetectorDefense,
    DetectorVictim,
    PatchAttack,
    PatchOracle,
    Predictions,
    Scenes,
)
from cavbench.detection.mount import Mount
from cavbench.envs.weather import WEATHERS
from cavbench.scenarios import Axes, Axis, Cell, Grid

SIDE, SIGN = 32, slice(8, 24)
"""Side of the images, and the range of the sign in both directions, in pixels."""

RED_AXES = Axes(
    (
        Axis(name="lanes", kind="int", meaning="number of lanes", choices=(3, 4, 5)),
        Axis(name="density", kind="float", meaning="density of the cars", choices=(1.0, 2.0)),
        Axis(
            name="weather",
            kind="str",
            meaning="the air and the light",
            choices=("clear", "rain", "fog", "night"),
            default="clear",
            perceptual=True,
        ),
    )
)
RED_V1 = Grid(
    name="red-v1",
    world="red_street",
    axes=RED_AXES,
    values={"lanes": (3, 4, 5), "density": (1.0, 2.0), "weather": ("clear", "rain", "fog")},
    episodes=3,
)


GREEN, NOTHING = Decoy("green", octagonal=True), Decoy("nothing", octagonal=False)


class RedScenes(Scenes):
    """A red square that fades with the distance and the extinction of the air."""

    size = (SIDE, SIDE)

    def __init__(self, distance: Tensor, extinction_per_m: float = 0.0) -> None:
        self.distance = distance
        self.boxes = torch.tensor([[8.0, 8.0, 24.0, 24.0]]).expand(len(distance), 4)
        self.visible = torch.ones(len(distance))
        self.red = torch.exp(-(extinction_per_m + 0.01) * distance)
        self.decoys = tuple((GREEN, NOTHING)[number % 2] for number in range(len(distance)))

    def render_decoys(self, frames: Tensor) -> Tensor:
        green = torch.tensor([self.decoys[number] is GREEN for number in frames.tolist()]).float()[:, None]
        faces = green * torch.tensor([0.0, 1.0, 0.0]) + (1 - green) * 0.5
        return self._shown(frames, faces[:, :, None, None].expand(len(frames), 3, 16, 16))

    def mounted(self, mount: Mount) -> Scenes:
        other = copy(self)
        other.mount = mount
        return other

    def reach(self, share: float) -> Tensor:
        half = 8 * share
        return torch.tensor([[16 - half, 16 - half, 16 + half, 16 + half]]).expand(len(self), 4)

    def render(self, frames: Tensor, patches: Tensor | None, share: float) -> Tensor:
        alone = self.mount.appears and patches is not None
        face = torch.tensor([0.5, 0.5, 0.5] if alone else [1.0, 0.0, 0.0])[:, None, None].expand(len(frames), 3, 16, 16)
        if patches is not None:
            side = round(16 * share)
            edge = (16 - side) // 2
            pasted = nn.functional.interpolate(patches, (side, side), mode="bilinear", antialias=True)
            padding = (edge, 16 - side - edge) * 2
            hole = nn.functional.pad(torch.ones(side, side), padding)
            face = face * (1 - hole) + nn.functional.pad(pasted, padding)
        return self._shown(frames, face)

    def _shown(self, frames: Tensor, face: Tensor) -> Tensor:
        pale = self.red[frames][:, None, None, None]
        return nn.functional.pad(face * pale + 0.5 * (1 - pale), (8, 8, 8, 8), value=0.5)


@dataclass(frozen=True, kw_only=True)
class RedStreet(CameraWorld):
    """Ten frames from 30 to 8 metres.

    Args:
        frames: of an approach.
    """

    axes: ClassVar[Axes] = RED_AXES
    grid: ClassVar[str] = RED_V1.name
    locations: ClassVar[tuple[str, ...]] = ("front", "side", "back")
    mounts: ClassVar[bool] = True
    frames: int = 10

    def training_scenes(self) -> Scenes:
        return RedScenes(torch.linspace(8, 30, 12))

    def approaches(self, cell: Cell, seeds: range) -> list[Approach]:
        def one(seed: int) -> Approach:
            place = seed % len(self.locations)
            nearer = 0.2 * place + 0.1 * cell.lanes + 0.05 * cell.density
            extinction = WEATHERS[cell.weather].extinction_per_m
            scenes = RedScenes(torch.linspace(30, 8, self.frames) - nearer, extinction)
            return Approach(seed=seed, location=self.locations[place], scenes=scenes)

        return [one(seed) for seed in seeds]


class RedDetector(Detector):
    """Two boxes, the sign's and a corner's; red boxes are stop signs."""

    names = ("car", "stop sign")
    stride = 8

    def __init__(self, bias: float = -2.0) -> None:
        super().__init__()
        self.shape = {"bias": bias}
        self.register_buffer("bias", torch.tensor(bias))

    def predict(self, pictures: Tensor) -> Predictions:
        boxes = torch.tensor([[8.0, 8.0, 24.0, 24.0], [0.0, 0.0, 8.0, 8.0]]).expand(len(pictures), 2, 4)
        redness = pictures[:, 0] - pictures[:, 1:].mean(1)
        red = torch.stack((redness[:, SIGN, SIGN].mean((1, 2)), redness[:, :8, :8].mean((1, 2))), 1)
        classes = torch.tensor([0.1, 0.9]).expand(len(pictures), 2, 2)
        return Predictions(boxes, torch.sigmoid(6 * red + self.bias), classes)


@dataclass(frozen=True, kw_only=True)
class RedVictim(DetectorVictim):
    """The victim of `RedDetector`."""

    def zoo_name(self) -> str:
        return "red"

    def load(self, seed: int, facts: Facts) -> Detector:
        return RedDetector().requires_grad_(False).eval()


class StopEverywhere(RedDetector):
    """Says "stop sign" with full confidence, wherever it has a box, whatever it sees."""

    def predict(self, pictures: Tensor) -> Predictions:
        found = super().predict(pictures)
        return Predictions(found.boxes, found.objectness * 0 + 1, torch.ones_like(found.classes))


@dataclass(frozen=True, kw_only=True)
class CheatingVictim(RedVictim):
    """The victim of `StopEverywhere`."""

    def load(self, seed: int, facts: Facts) -> Detector:
        return StopEverywhere().requires_grad_(False).eval()


@dataclass(frozen=True, kw_only=True)
class Paint(PatchAttack):
    """Signed gradient steps on the confidence, from random texels.

    Args:
        texels: side of the patch.
        steps: of the descent.
        pause: seconds to sleep at every step.
        mood: what it does beside that.
    """

    access: ClassVar[Access] = "gradients"
    texels: int = 8
    steps: int = 4
    pause: float = 0.0
    mood: Literal["calm", "loud", "void", "crooked", "greedy", "tamper", "raise", "kill", "mindful"] = "calm"

    def craft(self, oracle: PatchOracle, scenes: Scenes, progress: Progress) -> Tensor | None:
        if self.mood == "raise":
            raise ZeroDivisionError("the attack is at a loss")
        if self.mood == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.mood == "tamper":
            oracle._enforcer.detector.bias -= 1
        if self.mood == "mindful":
            # What it was shown, as texels: the distances of the frames in kilometres.
            shown = torch.zeros(3 * self.texels**2)
            shown[: len(scenes)] = scenes.distance / 1000
            return shown.reshape(3, self.texels, self.texels)
        frames = torch.arange(len(scenes))
        patch = torch.rand(1, 3, self.texels, self.texels, generator=oracle.generator)
        for step in range(10**9 if self.mood == "greedy" else self.steps):
            patch.requires_grad_(True)
            seen = oracle.differentiable(scenes.render(frames, patch, oracle.threat.budget))
            loss = seen.scores[..., oracle.label].mean()
            oracle.report(patch[0], score=loss, brightness=patch.mean())
            (gradient,) = torch.autograd.grad(loss, patch)
            patch = (patch - 0.2 * gradient.sign()).detach().clamp(0, 1)
            time.sleep(self.pause)
            progress((step + 1) / self.steps, f"loss {loss:.3f}")
        answers = {"loud": patch[0] * 3 - 1, "void": patch[0] * torch.nan, "crooked": patch[0, :, 1:]}
        return answers.get(self.mood, patch[0])


@dataclass(frozen=True, kw_only=True)
class Blank(PatchAttack):
    """A grey patch."""

    access: ClassVar[Access] = "oblivious"
    seeded: ClassVar[bool] = False

    def craft(self, oracle: PatchOracle, scenes: Scenes, progress: Progress) -> Tensor:
        return torch.full((3, 8, 8), 0.5)


@dataclass(frozen=True, kw_only=True)
class Harden(DetectorDefense):
    """Changes the bias of the detector, depending on the seed.

    Args:
        trained_in: the world it was trained in.
    """

    trained_in: str = ""

    def zoo_name(self, victim: DetectorVictim) -> str:
        return f"{victim.zoo_name()}-harden"

    def train(self, victim: Any, world: Any, *, seed: int, progress: Progress) -> Trained[Detector]:
        return Trained(RedDetector(bias=-1.0 - seed / 10), {"scenes": len(world.training_scenes())})

    def load(self, victim: DetectorVictim, seed: int, facts: Facts) -> Detector:
        return zoo.load(zoo.Recipe.of(victim, self), seed, RedDetector)
