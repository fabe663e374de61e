"""The bank of rendered frames: one file for each place and weather."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import asdict
from functools import cache
from math import ceil, floor
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from torch import Tensor

from cavbench.detection import Decoy, Objects, Scenes
from cavbench.detection.mount import Mount
from cavbench.envs.camera import faces, sign, training_faces, training_signs
from cavbench.envs.camera.frame import Frame, noise_level
from cavbench.envs.camera.layers import joined
from cavbench.envs.camera.objects import objects
from cavbench.envs.camera.plate import Box, Plate, common, detail, filtered, opened, signed, within
from cavbench.envs.camera.poses import Pose
from cavbench.envs.camera.street.layout import sign_x
from cavbench.envs.weather import WEATHERS
from cavbench.errors import UserError
from cavbench.files import whole

SHIPPED = Path(__file__).parent / "data"
Taken = Callable[[Tensor, int, Box], Tensor]
"""Makes what the camera takes of a developed part [3, h, w] of the image of a frame: the part, the frame, where the part is."""


def path_of(folder: Path, location: str, weather: str) -> Path:
    """The file of the frames of a place in a weather."""
    return folder / f"{location}-{weather}.safetensors"


def write(
    folder: Path, location: str, weather: str, poses: Sequence[Pose], frames: Sequence[Frame], made_by: object
) -> Path:
    """Write the frames of a place in a weather, atomically; return the file."""
    tensors: dict[str, NDArray[np.generic]] = {
        "crop": np.array([frame.crop for frame in frames], np.int32),
        "scale": np.array([frame.scale for frame in frames], np.float32),
        "printed": np.array([frame.printed for frame in frames], np.float32),
        "visible": np.array([frame.visible for frame in frames], np.float32),
    }
    for name in ("picture", "black", "gain"):
        parts = [getattr(frame, name).ravel() for frame in frames]
        tensors[name] = np.concatenate(parts)
        tensors[f"{name}_ends"] = np.cumsum([len(part) for part in parts]).astype(np.int64)
    metadata = {"poses": json.dumps([asdict(pose) for pose in poses]), "made_by": json.dumps(made_by)}
    path = path_of(folder, location, weather)
    folder.mkdir(parents=True, exist_ok=True)
    with whole(path) as file:
        file.write(save(tensors, metadata))
    return path


def read(folder: Path, location: str, weather: str) -> list[tuple[Pose, Frame]]:
    """The frames of a place in a weather.

    Raises:
        UserError: if the file is missing or cannot be read.
    """
    path = path_of(folder, location, weather)
    if not path.exists():
        raise UserError(f"no frames of {location} in {weather} at {path}; `bench render` makes them")
    try:
        with safe_open(path, "np") as file:
            held = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            poses = [Pose(**fields) for fields in json.loads(file.metadata()["poses"])]
        if "printed" not in held:
            raise UserError(f"the frames {path} are of an earlier version of cavbench; `bench render` makes them again")
        return _frames(poses, held)
    except (SafetensorError, ValueError, KeyError, IndexError, TypeError) as error:
        raise UserError(f"cannot read the frames {path}: {str(error).splitlines()[0]}") from None


def _frames(poses: Sequence[Pose], held: Mapping[str, NDArray[np.generic]]) -> list[tuple[Pose, Frame]]:
    """The poses with their frames, from the tensors of a file."""
    parts = {name: np.split(held[name], held[f"{name}_ends"][:-1]) for name in ("picture", "black", "gain")}
    found = []
    for number, pose in enumerate(poses):
        x0, y0, x1, y1 = (int(edge) for edge in held["crop"][number])
        shape = (y1 - y0, x1 - x0, 3)
        black_scale, gain_scale = held["scale"][number].tolist()
        red, green, blue = held["printed"][number].tolist()
        frame = Frame(
            picture=parts["picture"][number],
            crop=(x0, y0, x1, y1),
            black=parts["black"][number].reshape(shape),
            gain=parts["gain"][number].reshape(shape),
            scale=(black_scale, gain_scale),
            printed=(red, green, blue),
            visible=float(held["visible"][number]),
        )
        found.append((pose, frame))
    return found


GRAIN_SHIFT = 97
"""All frames share one noise field; each frame starts at its own offset of fewer pixels than this, down and right."""


@cache
def _grain(height: int, width: int) -> Tensor:
    """Sensor noise [3, height, width] with standard deviation 1."""
    return torch.randn(3, height, width, generator=torch.Generator().manual_seed(0))


class BankScenes(Scenes):
    """Frames of the bank, in the order given.

    Args:
        frames: poses with their frames.
        weathers: name of the weather of each frame.
    """

    decoys: tuple[Decoy, ...]

    def __init__(self, frames: Sequence[tuple[Pose, Frame]], weathers: Sequence[str]) -> None:
        self.poses = tuple(pose for pose, _ in frames)
        self.frames = tuple(frame for _, frame in frames)
        self.weathers = tuple(weathers)
        camera = self.poses[0].camera
        self.size = (camera.height, camera.width)
        limit = np.array([camera.width, camera.height] * 2)
        boxes = [sign.box(sign_x(pose.lanes), pose.camera).clip(0, limit) for pose in self.poses]
        self.boxes = torch.from_numpy(np.array(boxes)).float()
        self.visible = torch.tensor([frame.visible for frame in self.frames])
        self.distance = torch.tensor([pose.distance for pose in self.poses])
        # So that over the places and roads each decoy is seen at every distance.
        first = self.poses[0].seed
        self.decoys = tuple(faces.DECOYS[(first + n) % len(faces.DECOYS)] for n in range(len(self.poses)))
        self.faces = faces.of_sheet(first, len(self.poses))
        self._plates: dict[int, Plate] = {}

    def redrawn(self, number: int, like_signs: bool = False) -> BankScenes:
        return self

    def with_decoys(self, decoys: Sequence[Decoy]) -> BankScenes:
        other = copy(self)
        other.decoys = tuple(decoys)
        return other

    def apart(self) -> Scenes:
        other = super().apart()
        assert isinstance(other, BankScenes)
        # Opened plates are written to like any image.
        other._plates = {}
        return other

    def mounted(self, mount: Mount) -> BankScenes:
        if mount == self.mount:
            return self
        other = copy(self)
        other.mount = mount
        if mount.appears:
            other.decoys = (Decoy("plate", octagonal=False),) * len(self)
        return other

    def objects(self, frame: int) -> Objects:
        found = objects(self.poses[frame])
        boxes = np.array([box for _, box in found]).reshape(-1, 4)
        return Objects(torch.from_numpy(boxes).float(), tuple(name for name, _ in found))

    def render(self, frames: Tensor, patches: Tensor | None, share: float) -> Tensor:
        corners = torch.zeros(len(frames), 2, dtype=torch.int64)
        return self.windows(frames, patches, share, corners, self.size)

    def render_decoys(self, frames: Tensor) -> Tensor:
        return self.with_noise(self.developed_decoys(frames), frames)

    def windows(
        self, frames: Tensor, patches: Tensor | None, share: float, corners: Tensor, size: tuple[int, int]
    ) -> Tensor:
        return self._shown(frames, patches, share, corners, size, self._noisy)

    def developed(self, frames: Tensor, patches: Tensor | None, share: float) -> Tensor:
        """The images of `render` without sensor noise."""
        corners = torch.zeros(len(frames), 2, dtype=torch.int64)
        return self._shown(frames, patches, share, corners, self.size, _as_it_is)

    def developed_decoys(self, frames: Tensor) -> Tensor:
        """The images of `render_decoys` without sensor noise."""
        return torch.stack(
            [self._plate(number).carrying(faces.face(self.decoys[number].name)) for number in frames.tolist()]
        )

    def with_noise(self, pictures: Tensor, frames: Tensor) -> Tensor:
        """Images [N, 3, H, W] of frames with sensor noise."""
        whole = (0, 0, self.size[1], self.size[0])
        return torch.stack(
            [self._noisy(picture, number, whole) for picture, number in zip(pictures, frames.tolist(), strict=True)]
        )

    def _shown(
        self, frames: Tensor, patches: Tensor | None, share: float, corners: Tensor, size: tuple[int, int], taken: Taken
    ) -> Tensor:
        """Windows [N, 3, h, w] of the images, as `taken` makes them of developed ones."""
        numbers = frames.tolist()
        windows = [(x, y, x + size[1], y + size[0]) for x, y in corners.tolist()]
        if patches is not None and self.mount.appears:
            shown = self._plates_alone(numbers, patches, share, windows)
            return torch.stack([taken(*one) for one in zip(shown, numbers, windows, strict=True)])
        with torch.no_grad():
            plain = [
                taken(self._plate(number).cut(window), number, window)
                for number, window in zip(numbers, windows, strict=True)
            ]
        pictures = torch.stack(plain)
        if patches is None:
            return pictures
        where, parts = [], []
        for place, part, picture in self._patched(numbers, patches, share, windows):
            _, rows, columns = within(part, windows[place])
            where.append((place, rows, columns))
            parts.append(taken(picture, numbers[place], part))
        return joined(pictures, where, parts)

    def _patched(
        self, numbers: Sequence[int], patches: Tensor, share: float, windows: Sequence[Box]
    ) -> Iterator[tuple[int, Box, Tensor]]:
        """The developed parts [3, h, w] of windows that a patch changes: the number of the window, the part, its pixels."""
        beside = self.mount.place == "beside"
        found: list[tuple[int, Box]] = []
        for place, (number, window) in enumerate(zip(numbers, windows, strict=True)):
            reach, crop = _reach(self.poses[number], share, self.mount), self._plate(number).crop
            if part := common(window, reach) if beside else common(window, crop, reach):
                found.append((place, part))
        if beside:
            (spot,) = self.mount.spots(share)
            for place, part in found:
                plate = self._plate(numbers[place])
                shown = plate.cut(part)
                yield place, part, plate.beside(shown, part, patches[place % len(patches)], spot)
            return
        plates = {place: self._plate(numbers[place]) for place, _ in found}
        painted = {plate.printed: None for plate in plates.values()}
        lit = {printed: sign.painted(patches, share, printed, self.mount) for printed in painted}
        faces = {
            (side, printed): filtered(lit[printed], side).unbind()
            for side, printed in dict.fromkeys(_kind(plate) for plate in plates.values())
        }
        # Parts with the same face come together: so the face has one gradient.
        alike: dict[tuple[tuple[int, sign.Colour], int], list[tuple[int, Box]]] = {}
        for place, part in found:
            alike.setdefault((_kind(plates[place]), place % len(patches)), []).append((place, part))
        for (kind, patch), same in alike.items():
            own = [(plates[place], part) for place, part in same]
            for (place, part), picture in zip(same, signed(faces[kind][patch], own), strict=True):
                yield place, part, picture

    def _plates_alone(
        self, numbers: Sequence[int], patches: Tensor, share: float, windows: Sequence[Box]
    ) -> list[Tensor]:
        """Developed windows [3, h, w] with each patch on a plate of its own, on the post without the sign."""
        cover, shown = self.mount.cover(share, sign.TEXELS), []
        light = sign.painted(patches, share, mount=self.mount)
        for place, (number, window) in enumerate(zip(numbers, windows, strict=True)):
            plate = self._plate(number)
            face = faces.Face(light[place % len(light)] * torch.tensor(plate.printed).view(3, 1, 1), cover)
            shown.append(plate.carrying(face)[within(window, (0, 0, 0, 0))])
        return shown

    def reach(self, share: float) -> Tensor:
        return torch.tensor([_reach(pose, share, self.mount) for pose in self.poses], dtype=torch.float32)

    def _plate(self, number: int) -> Plate:
        """The opened plate of a frame, cached in these scenes: about 2 MB."""
        if number not in self._plates:
            pose = self.poses[number]
            self._plates[number] = opened(self.frames[number], pose.camera, sign_x(pose.lanes))
        return self._plates[number]

    def _noisy(self, picture: Tensor, number: int, part: Box) -> Tensor:
        """A part [3, h, w] of the image of a frame with sensor noise."""
        height, width = self.size
        seed = self.poses[number].seed
        down, right = seed % GRAIN_SHIFT, seed // GRAIN_SHIFT % GRAIN_SHIFT
        grain = _grain(height + GRAIN_SHIFT, width + GRAIN_SHIFT)[within(part, (-right, -down, width, height))]
        return picture.add(grain, alpha=noise_level(WEATHERS[self.weathers[number]])).clamp_(0, 1)


class TrainingScenes(BankScenes):
    """Frames for training, with decoys that are never scored."""

    def __init__(self, frames: Sequence[tuple[Pose, Frame]], weathers: Sequence[str]) -> None:
        super().__init__(frames, weathers)
        self.decoys, self.faces = training_faces.decoys(0, len(self)), ()

    def redrawn(self, number: int, like_signs: bool = False) -> BankScenes:
        source = training_signs if like_signs else training_faces
        return self.with_decoys(source.decoys(number * len(self), len(self)))


def _as_it_is(picture: Tensor, number: int, part: Box) -> Tensor:
    return picture


def _kind(plate: Plate) -> tuple[int, sign.Colour]:
    """Plates of one kind show a patch with the same face."""
    return detail(plate.crop), plate.printed


@cache
def _reach(pose: Pose, share: float, mount: Mount) -> Box:
    """The box of the pixels that a patch can change: those it covers, plus one on each side for texture filtering."""
    x0, y0, x1, y1 = sign.patch_box(share, sign_x(pose.lanes), pose.camera, mount)
    return floor(x0) - 1, floor(y0) - 1, ceil(x1) + 1, ceil(y1) + 1
