"""The rules for camera worlds."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from bench.conformance.check import Check, Suite, require
from bench.conformance.scenarios import first_cell
from bench.detection import STOP_SIGN, CameraWorld, Scenes
from bench.plugins import registry
from bench.scenarios import SeedBlock

FRAMES = 3
SHARE = 0.5
TEXELS = 8
VISIBLE = 0.9
"""A frame in which the patch must be seen shows this share of the sign."""


class CameraSuite(Suite):
    """Of a `CameraWorld`, on a few of its frames."""

    component: CameraWorld

    def checks(self) -> Mapping[str, Check]:
        return {
            "places": self.places,
            "training scenes": self.scenes,
            "pictures": self.pictures,
            "patches": self.patches,
            "windows": self.windows,
            "reach": self.reach,
            "cells": self.every_cell,
            "approaches": self.approaches,
            "determinism": self.same_seed_same_approach,
        }

    def places(self) -> None:
        """Names of the places, and of what there is to find."""
        require(self.component.locations, "locations is empty: name the places that are scored")
        require(STOP_SIGN in self.component.classes, f"none of its classes is {STOP_SIGN!r}")

    def scenes(self) -> None:
        """As many boxes, distances and shares as frames."""
        self._check_scenes(self.component.training_scenes())

    def pictures(self) -> None:
        """In range, and a frame is the same whatever is rendered with it."""
        scenes, frames = self._some()
        together = scenes.render(frames, None, SHARE)
        shape = (FRAMES, 3, *scenes.size)
        require(tuple(together.shape) == shape, f"render gives {list(together.shape)}, not {list(shape)}")
        require(bool(((together >= 0) & (together <= 1)).all()), "render gives colours outside [0, 1]")
        alone = scenes.render(frames[1:2], None, SHARE)
        require(torch.allclose(together[1:2], alone, atol=1e-5), "a frame changes with the others that are rendered")

    def patches(self) -> None:
        """A patch is seen, and the way back to its texels is open."""
        scenes, frames = self._some()
        patch = self._patch().requires_grad_(True)
        shown = scenes.render(frames, patch, SHARE)
        bare = scenes.render(frames, None, SHARE)
        require(
            bool((shown != bare).flatten(1).any(1).all()), "a patch changes no pixel of a frame that shows the sign"
        )
        require(shown.requires_grad, "the pictures have no graph to the patch")
        (gradient,) = torch.autograd.grad(shown.sum(), patch)
        require(
            bool(gradient.isfinite().all() and gradient.any()), "the gradient of the pictures in the patch is 0 or NaN"
        )

    def windows(self) -> None:
        """A part is what would be cut out of the picture."""
        scenes, frames = self._some()
        patch, size = self._patch(), (32, 32)
        limit = torch.tensor([scenes.size[1], scenes.size[0]]) - 32
        corners = torch.minimum(scenes.boxes[frames][:, :2].long().clamp(min=0), limit)
        cut = Scenes.windows(scenes, frames, patch, SHARE, corners, size)
        parts = scenes.windows(frames, patch, SHARE, corners, size)
        require(torch.allclose(parts, cut, atol=1e-3), "windows differs from what render shows there")

    def reach(self) -> None:
        """Outside of `reach` a patch changes nothing."""
        scenes, frames = self._some()
        changed = (scenes.render(frames, self._patch(), SHARE) - scenes.render(frames, None, SHARE)).abs().amax(1)
        for picture, box in zip(changed, scenes.reach(SHARE)[frames], strict=True):
            left, top = box[:2].floor().long().clamp(min=0).tolist()
            right, bottom = box[2:].ceil().long().tolist()
            outside = picture.clone()
            outside[top:bottom, left:right] = 0
            require(float(outside.max()) < 1e-4, "a patch changes pixels outside of reach: make the boxes larger")

    def every_cell(self) -> str:
        """There is an approach in every cell of the default grid."""
        grid = registry.grid(self.component.grid)
        for cell in grid.cells():
            found = self.component.approaches(cell, range(SeedBlock.REPORT, SeedBlock.REPORT + 1))
            require(len(found) == 1, f"approaches gives {len(found)} for one seed in the cell {cell}: give one a seed")
        return f"{len(grid.cells())} cells"

    def approaches(self) -> None:
        """One a seed, at the place of the seed, farthest first, all of the same length."""
        places = self.component.locations
        seeds = range(SeedBlock.REPORT, SeedBlock.REPORT + len(places))
        found = self.component.approaches(first_cell(self.component), seeds)
        require([one.seed for one in found] == list(seeds), "approaches must give one for each seed, in order")
        wanted = [places[seed % len(places)] for seed in seeds]
        require([one.location for one in found] == wanted, "a seed's place must be locations[seed % len(locations)]")
        require(len({len(one.scenes) for one in found}) == 1, "approaches differ in their number of frames")
        for one in found:
            self._check_scenes(one.scenes)
            require(bool((one.scenes.distance.diff() < 0).all()), "frames must come farthest first")

    def same_seed_same_approach(self) -> None:
        """An approach is fixed by its seed."""
        frames = torch.tensor([0])
        first, second = (
            self.component.approaches(first_cell(self.component), range(SeedBlock.REPORT, SeedBlock.REPORT + 1))[
                0
            ].scenes.render(frames, None, SHARE)
            for _ in range(2)
        )
        require(torch.equal(first, second), "the same seed gives two different pictures")

    def _check_scenes(self, scenes: Scenes) -> None:
        count = len(scenes)
        require(count, "there are no frames")
        require(scenes.boxes.shape == (count, 4), f"boxes is {list(scenes.boxes.shape)}, not [{count}, 4]")
        for name in ("visible", "distance"):
            shape = list(getattr(scenes, name).shape)
            require(shape == [count], f"{name} is {shape}, not [{count}]")
        require(bool(((scenes.visible >= 0) & (scenes.visible <= 1)).all()), "visible leaves [0, 1]")
        require(bool((scenes.distance > 0).all()), "a distance is not above 0")

    def _some(self) -> tuple[Scenes, Tensor]:
        """A few frames in which the sign is to be seen, the nearest."""
        scenes = self.component.training_scenes()
        seen = (scenes.visible >= VISIBLE).nonzero().squeeze(1)
        nearest = scenes.distance[seen].argsort()[:FRAMES]
        require(len(nearest) == FRAMES, f"the whole sign is seen in fewer than {FRAMES} training frames")
        return scenes, seen[nearest]

    def _patch(self) -> Tensor:
        return torch.rand(1, 3, TEXELS, TEXELS, generator=torch.Generator().manual_seed(0))
