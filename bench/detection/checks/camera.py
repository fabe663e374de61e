"""Rules for camera worlds."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from cavbench.checks.check import Check, NotApplicableError, Suite, require
from cavbench.checks.scenarios import first_cell
from cavbench.core import registry
from cavbench.detection import STOP_SIGN, CameraWorld, Scenes
from cavbench.scenarios import SeedBlock

FRAMES = 3
SHARE = 0.5
TEXELS = 8
VISIBLE = 0.9
"""The patch must be visible in frames that show at least this share of the sign."""


class CameraSuite(Suite):
    """Checks of a `CameraWorld`, on a few of its frames."""

    component: CameraWorld

    def checks(self) -> Mapping[str, Check]:
        return {
            "places": self.places,
            "training scenes": self.scenes,
            "pictures": self.pictures,
            "patches": self.patches,
            "windows": self.windows,
            "reach": self.reach,
            "decoys": self.decoys,
            "cells": self.every_cell,
            "approaches": self.approaches,
            "determinism": self.same_seed_same_approach,
            "closed loop": self.closed_loop,
        }

    def places(self) -> None:
        """It has locations, and a stop sign among its classes."""
        require(self.component.locations, "locations is empty: name the locations of its approaches")
        require(STOP_SIGN in self.component.classes, f"none of its classes is {STOP_SIGN!r}")

    def scenes(self) -> None:
        """The training scenes have one box, distance and visible share per frame."""
        self._check_scenes(self.component.training_scenes())

    def pictures(self) -> None:
        """Colours are in [0, 1], and a frame does not depend on the others that are rendered with it."""
        scenes, frames = self._some()
        together = scenes.render(frames, None, SHARE)
        shape = (FRAMES, 3, *scenes.size)
        require(tuple(together.shape) == shape, f"render returns shape {list(together.shape)}, not {list(shape)}")
        require(bool(((together >= 0) & (together <= 1)).all()), "render returns colours outside [0, 1]")
        alone = scenes.render(frames[1:2], None, SHARE)
        require(
            torch.allclose(together[1:2], alone, atol=1e-5), "a frame depends on the others that are rendered with it"
        )

    def patches(self) -> None:
        """A patch is visible, and the images have a gradient with respect to its texels."""
        scenes, frames = self._some()
        patch = self._patch().requires_grad_(True)
        shown = scenes.render(frames, patch, SHARE)
        bare = scenes.render(frames, None, SHARE)
        require(
            bool((shown != bare).flatten(1).any(1).all()), "a patch changes no pixel of a frame that shows the sign"
        )
        require(shown.requires_grad, "the images have no graph to the patch: use differentiable operations in render")
        (gradient,) = torch.autograd.grad(shown.sum(), patch)
        require(
            bool(gradient.isfinite().all() and gradient.any()),
            "the gradient of the images with respect to the patch is 0 or NaN",
        )

    def windows(self) -> None:
        """`windows` equals crops of the rendered images."""
        scenes, frames = self._some()
        patch, size = self._patch(), (32, 32)
        limit = torch.tensor([scenes.size[1], scenes.size[0]]) - 32
        corners = torch.minimum(scenes.boxes[frames][:, :2].long().clamp(min=0), limit)
        cut = Scenes.windows(scenes, frames, patch, SHARE, corners, size)
        parts = scenes.windows(frames, patch, SHARE, corners, size)
        require(torch.allclose(parts, cut, atol=1e-3), "windows differs from crops of render")

    def reach(self) -> None:
        """A patch changes no pixels outside of `reach`."""
        scenes, frames = self._some()
        changed = (scenes.render(frames, self._patch(), SHARE) - scenes.render(frames, None, SHARE)).abs().amax(1)
        for picture, box in zip(changed, scenes.reach(SHARE)[frames], strict=True):
            left, top = box[:2].floor().long().clamp(min=0).tolist()
            right, bottom = box[2:].ceil().long().tolist()
            outside = picture.clone()
            outside[top:bottom, left:right] = 0
            require(float(outside.max()) < 1e-4, "a patch changes pixels outside of reach: make the boxes larger")

    def decoys(self) -> str:
        """Each frame has a decoy; its image is a frame without the stop sign, and the same every time."""
        scenes, frames = self._some()
        known = {one.name for one in scenes.decoys}
        if not known:
            raise NotApplicableError("it has no decoys: nothing shows whether a detector knows the sign's face")
        require(len(scenes.decoys) == len(scenes), f"there are {len(scenes.decoys)} decoys for {len(scenes)} frames")
        shown = scenes.render_decoys(frames)
        shape = (FRAMES, 3, *scenes.size)
        require(tuple(shown.shape) == shape, f"render_decoys returns shape {list(shown.shape)}, not {list(shape)}")
        require(bool(((shown >= 0) & (shown <= 1)).all()), "render_decoys returns colours outside [0, 1]")
        require(torch.equal(shown, scenes.render_decoys(frames)), "the decoys of a frame change from call to call")
        signs = scenes.render(frames, None, SHARE)
        require(bool((shown != signs).flatten(1).any(1).all()), "a decoy's image is that of the stop sign")
        return f"{len(known)} in the training scenes"

    def every_cell(self) -> str:
        """Every cell of the default grid has approaches."""
        grid = registry.grid(self.component.grid)
        for cell in grid.cells():
            found = self.component.approaches(cell, range(SeedBlock.REPORT, SeedBlock.REPORT + 1))
            require(
                len(found) == 1, f"approaches returns {len(found)} for one seed in the cell {cell}: return one per seed"
            )
        return f"{len(grid.cells())} cells"

    def approaches(self) -> None:
        """There is one approach per seed, at the location of the seed, farthest frame first, all of the same length."""
        places = self.component.locations
        seeds = range(SeedBlock.REPORT, SeedBlock.REPORT + len(places))
        found = self.component.approaches(first_cell(self.component), seeds)
        require(
            [one.seed for one in found] == list(seeds), "approaches must return one approach for each seed, in order"
        )
        wanted = [places[seed % len(places)] for seed in seeds]
        require(
            [one.location for one in found] == wanted, "the location of a seed must be locations[seed % len(locations)]"
        )
        require(len({len(one.scenes) for one in found}) == 1, "approaches have different numbers of frames")
        for one in found:
            self._check_scenes(one.scenes)
            require(bool((one.scenes.distance.diff() < 0).all()), "frames must come farthest first")

    def same_seed_same_approach(self) -> None:
        """The seed determines the approach."""
        frames = torch.tensor([0])
        first, second = (
            self.component.approaches(first_cell(self.component), range(SeedBlock.REPORT, SeedBlock.REPORT + 1))[
                0
            ].scenes.render(frames, None, SHARE)
            for _ in range(2)
        )
        require(torch.equal(first, second), "the same seed gives two different images")

    def closed_loop(self) -> str:
        """Its environment has one car, shows the frame that it names, and draws cross traffic for each seed."""
        cell, seeds = first_cell(self.component), range(SeedBlock.REPORT, SeedBlock.REPORT + 2)
        env = self.component.environment(cell, seeds, None, SHARE)
        if env is None:
            return "none"
        require(tuple(env.batch_size) == (1,), f"its environment has {list(env.batch_size)} cars, not one")
        now = env.reset()
        missing = {"distance", "speed", "frame", "shown", "box", "others", "hit", "braked"} - set(now["info"].keys())
        require(not missing, f"the info of its environment lacks {', '.join(sorted(missing))}")
        for name in ("hit", "braked"):
            shape = tuple(now["info", name].shape)
            require(shape == (1, len(seeds)), f"info.{name} must have one value for each seed")
        require(env.sign_px_m > 0, f"sign_px_m of its environment must be above 0, got {env.sign_px_m}")
        scenes, frame = self.component.approaches(cell, seeds[:1])[0].scenes, now["info", "frame"][0]
        require(
            torch.allclose(now["observation"], scenes.render(frame, None, SHARE), atol=1e-5),
            "the first image of its environment is not the frame that it names",
        )
        return "one car"

    def _check_scenes(self, scenes: Scenes) -> None:
        count = len(scenes)
        require(count, "the scenes have no frames")
        require(scenes.boxes.shape == (count, 4), f"boxes is {list(scenes.boxes.shape)}, not [{count}, 4]")
        for name in ("visible", "distance"):
            shape = list(getattr(scenes, name).shape)
            require(shape == [count], f"{name} is {shape}, not [{count}]")
        require(bool(((scenes.visible >= 0) & (scenes.visible <= 1)).all()), "visible is outside [0, 1]")
        require(bool((scenes.distance > 0).all()), "distances must be above 0")

    def _some(self) -> tuple[Scenes, Tensor]:
        """The nearest frames in which the sign is visible."""
        scenes = self.component.training_scenes()
        seen = (scenes.visible >= VISIBLE).nonzero().squeeze(1)
        nearest = scenes.distance[seen].argsort()[:FRAMES]
        require(len(nearest) == FRAMES, f"fewer than {FRAMES} training frames show at least {VISIBLE:.0%} of the sign")
        return scenes, seen[nearest]

    def _patch(self) -> Tensor:
        return torch.rand(1, 3, TEXELS, TEXELS, generator=torch.Generator().manual_seed(0))
