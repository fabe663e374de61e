"""Score a defended detector on approaches to a stop sign that may have a patch on it."""

from __future__ import annotations

import random
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.detection import stopping
from cavbench.detection.boxes import confidence, overlap
from cavbench.detection.closed_loop import Drives
from cavbench.detection.detector import STOP_SIGN, Detections, Detector
from cavbench.detection.discrimination import certified, discrimination, if_visible, stops_by_family
from cavbench.detection.mount import Mount
from cavbench.detection.patch import Patch
from cavbench.detection.printing import non_printability
from cavbench.detection.scenes import Approach, Scenes
from cavbench.detection.sight import SAME_IOU, Sight, certain, look, look_at_decoys, look_at_faces
from cavbench.isolation.modes import kept
from cavbench.isolation.streams import put_back

Columns = dict[str, NDArray[np.generic]]

OF_GRADIENTS = ("zero_gradients", "nan_gradients")
"""Counts of a crafting that are recorded as shares of its gradients."""
SAME_CONFIDENCE = 0.01
"""Two confidences count as the same answer if they differ by at most this."""
REPEATS = 3
"""How often a random detector is asked again."""
LARGEST_BATCH = 5
"""Most images in the batch of a probe."""
SAME_MEAN = 0.1
"""Largest difference of an approach's mean confidence from that which attacks optimise. Fusion over frames has up to .01."""


@dataclass(frozen=True)
class Sighting:
    """The detector's output on an approach, with and without the patch.

    Args:
        approach: the approach.
        patch: the patch on the sign; None for no patch.
        share: side of the patch as a share of the sign's side.
        shown: the output that was scored.
        clean: the output without the patch; None if there is no patch.
        drives: the closed loop; None if the world has none.
    """

    approach: Approach
    patch: Patch | None
    share: float
    shown: Sight
    clean: Sight | None
    drives: Drives | None = None

    @property
    def texels(self) -> Tensor | None:
        """The patch [3, P, P]; None if there is none."""
        return self.patch.texels if self.patch else None


@dataclass(frozen=True)
class Unpatched:
    """The detector's output on A approaches that is the same whatever patch is on the sign.

    Args:
        scenes: the S distinct scenes of the approaches; each frame is looked at once.
        of_approach: [A] the number of each approach's scenes.
        decoys: [S] the output on the decoys; None for a world without decoys.
        least: [S] what is certain under every patch; None without a certificate or a patch.
        faces: [S] the output on faces that no training sees; None for a world without them.
    """

    scenes: Sequence[Scenes]
    of_approach: NDArray[np.int64]
    decoys: Sequence[Sight | None]
    least: Sequence[NDArray[np.float32] | None]
    faces: Sequence[Sight | None]

    def at(self, first: int, end: int) -> Unpatched:
        """That of the approaches from `first` to `end`, which have the same scenes."""
        number = self.of_approach[first]
        own = [self.scenes[number]], np.zeros(end - first, np.int64)
        return Unpatched(*own, [self.decoys[number]], [self.least[number]], [self.faces[number]])

    @classmethod
    def of(cls, detector: Detector, approaches: Sequence[Approach], share: float) -> Unpatched:
        """Run the detector; `share` is the side of patches as a share of the sign's side."""
        scenes, of_approach = _distinct([approach.scenes for approach in approaches])
        with torch.no_grad():
            # Where a plate appears, it is what stands in the sign's place.
            decoys = [None if one.mount.appears else look_at_decoys(detector, one) for one in scenes]
            # Without an attack, or with light or a plate, no patch hides a part of the sign.
            covered = [share and one.mount.covers for one in scenes]
            least = [certain(detector, one, share) if some else None for one, some in zip(scenes, covered, strict=True)]
            # Last, so that a random detector draws the same as before for the others.
            faces = [None if one.mount.appears else look_at_faces(detector, one) for one in scenes]
        return cls(scenes, of_approach, decoys, least, faces)


@dataclass(frozen=True)
class Trace:
    """Some approaches of a unit, for recordings: `episodes` are indices into its seeds, `sightings` has one item for each."""

    episodes: Sequence[int]
    sightings: list[Sighting] = field(default_factory=list)


def score(
    detector: Detector,
    approaches: Sequence[Approach],
    patch: Patch | None,
    *,
    share: float,
    entropy: int = 0,
    trace: Trace | None = None,
    unpatched: Unpatched | None = None,
) -> Columns:
    """Run a detector on every frame of A approaches and return the measurements, [A] each.

    Args:
        detector: the (defended) victim.
        approaches: the approaches.
        patch: the patch on the sign; None for no patch.
        share: side of the patch as a share of the sign's side.
        entropy: seed of the frame that is probed; no measurement depends on it.
        trace: collects the detector's output on its episodes.
        unpatched: the output without the patch on the same approaches, if it is known; it is the same for all patches.
    """
    texels = patch.texels if patch else None
    known = unpatched or Unpatched.of(detector, approaches, share)
    scenes, of_approach = known.scenes, known.of_approach
    appears = scenes[0].mount.appears
    decoys = known.decoys
    with torch.no_grad():
        looks = [look(detector, one, texels, share) for one in scenes]
        seen = [looks[number] for number in of_approach]
        if trace:
            for place in trace.episodes:
                clean = look(detector, approaches[place].scenes, None, share) if texels is not None else None
                trace.sightings.append(Sighting(approaches[place], patch, share, seen[place], clean))
        if appears:
            # The plate is scored as a decoy, beside the sign as it is.
            decoys = [look(detector, at_plates(one, share), texels, share) for one in scenes]
            looks = [look(detector, one, None, share) for one in scenes]
            seen, texels = [looks[number] for number in of_approach], None
    crafted = patch or Patch(texels=None)
    constant = {
        "patch_sha256": crafted.sha256,
        "queries": crafted.queries,
        "gradients": crafted.gradients,
        "crafting_s": crafted.seconds,
        "excess": crafted.excess,
        "gradient_queries": float(crafted.gradients),
        **{
            name: getattr(crafted, name) / max(crafted.gradients, 1) if crafted.gradients else np.nan
            for name in OF_GRADIENTS
        },
        "draws": np.nan,
        "non_printability": np.nan if crafted.texels is None else float(non_printability(crafted.texels)),
        **probed(detector, approaches, seen, texels, share, entropy),
    }
    of_scenes = {
        **measured(looks, scenes),
        **discrimination(looks, decoys, scenes),
        **certified(known.least, looks, decoys),
        **stops_by_family(known.faces, scenes),
        **if_visible(looks, scenes),
    }
    return {
        "seed": np.array([approach.seed for approach in approaches], np.int64),
        "location": np.array([approach.location for approach in approaches]),
        **{name: np.array([value] * len(approaches)) for name, value in constant.items()},
        **{name: values[of_approach] for name, values in of_scenes.items()},
    }


def mounted(approaches: Sequence[Approach], mount: Mount) -> list[Approach]:
    """The approaches with patches shown in another way; those with the same scenes still have the same."""
    scenes = {id(one.scenes): one.scenes.mounted(mount) for one in approaches}
    return [replace(one, scenes=scenes[id(one.scenes)]) for one in approaches]


def at_plates(scenes: Scenes, share: float) -> Scenes:
    """The same frames with the boxes of plates that appear, instead of the sign's."""
    other = copy(scenes)
    height, width = scenes.size
    other.boxes = scenes.reach(share).minimum(torch.tensor([width, height] * 2)).clamp(min=0)
    return other


def _distinct(scenes: Sequence[Scenes]) -> tuple[list[Scenes], NDArray[np.int64]]:
    """The distinct objects, in order, and the number of each one's."""
    known = {id(one): one for one in scenes}
    numbers = {key: number for number, key in enumerate(known)}
    return list(known.values()), np.array([numbers[id(one)] for one in scenes])


def probed(
    detector: Detector,
    approaches: Sequence[Approach],
    seen: Sequence[Sight],
    texels: Tensor | None,
    share: float,
    entropy: int,
) -> dict[str, float | int]:
    """Probes on a frame that the detector cannot foresee (`cavbench.records.schema.PROBES`).

    `redrawn`: another answer when asked again. `same_answer`: the same on a grey image. `inconsistent`: asked as an oracle asks,
    in batches of other sizes and with gradients, an answer is not the one that was scored; or, on any approach, what it reports
    on average is not what its `aggregate` makes of the frames' scores, which attacks optimise.
    """
    chance = random.Random(entropy)
    place = chance.randrange(len(approaches))
    scenes = approaches[place].scenes
    frame = chance.randrange(len(scenes))
    patches = texels.unsqueeze(0) if texels is not None else None
    image, box, label = (
        scenes.render(torch.tensor([frame]), patches, share),
        scenes.boxes[[frame]],
        detector.index(STOP_SIGN),
    )

    def batched() -> tuple[Tensor, int]:
        """The image in a batch of a size and at a place that nobody can foresee."""
        size = chance.randint(1, LARGEST_BATCH)
        at = chance.randrange(size)
        return torch.full_like(image, 0.5).repeat(size, 1, 1, 1).index_copy(0, torch.tensor([at]), image), at

    def ask(pictures: Tensor, at: int = 0, gradients: bool = False) -> float:
        with torch.set_grad_enabled(gradients), kept("defense"):
            output = detector(pictures.clone().requires_grad_(gradients))
        boxes = box.to(output.boxes).expand(len(pictures), 4)
        return float(confidence(output, label, boxes, iou=SAME_IOU)[at].detach())

    with put_back():
        first, again = ask(image), ask(image)
        grey = ask(torch.full_like(image, 0.5))
        # A random detector must not look like a decoy.
        repeated = [first, again, *(ask(image) for _ in range(REPEATS if first != again else 0))]
        answers = [first, ask(*batched()), ask(*batched(), gradients=True)]
    scored = float(seen[place].by_frame[frame])
    spread = max(*repeated, scored) - min(*repeated, scored) if first != again else 0.0
    return {
        "redrawn": float(first != again),
        "same_answer": float(abs(first - grey) <= SAME_CONFIDENCE),
        "inconsistent": float(
            any(abs(answer - scored) > SAME_CONFIDENCE + 4 * spread for answer in answers)
            or any(misled(detector, sight) for sight in seen)
        ),
        "entropy": entropy,
    }


def misled(detector: Detector, sight: Sight) -> bool:
    """Whether what attacks optimise, `Detector.aggregate` of the frames' scores, is not what was reported."""
    with kept("defense"):
        optimised = detector.aggregate(torch.from_numpy(sight.by_frame.copy()))
    return not abs(float(optimised.mean()) - float(sight.confidence.mean())) <= SAME_MEAN


def false_alarms(found: Sequence[Detections], boxes: Tensor) -> NDArray[np.int64]:
    """[N] number of detections in each image that are not the object at `boxes` [N, 4]."""
    return np.array([int((overlap(one.boxes, box) < SAME_IOU).sum()) for one, box in zip(found, boxes, strict=True)])


def measured(seen: Sequence[Sight], scenes: Sequence[Scenes]) -> Columns:
    """The measurements of A approaches, [A] each."""
    frames = {name: np.stack([getattr(one, name) for one in scenes]) for name in ("distance", "visible")}
    alarms = [false_alarms(sight.found, one.boxes).mean() for sight, one in zip(seen, scenes, strict=True)]
    return {
        "false_alarms": np.array(alarms),
        **measure(
            np.stack([sight.confidence for sight in seen]).astype(np.float64),
            frames["distance"].astype(np.float64),
            frames["visible"].astype(np.float64),
        ),
    }


def measure(confidence: stopping.Array, distance_m: stopping.Array, visible: stopping.Array) -> Columns:
    """The measurements of A approaches, [A] each, except false alarms; frames in driving order.

    Args:
        confidence: [A, F], confidence in the sign at its true place, in [0, 1]; 0 without a box there.
        distance_m: [A, F], distance to the sign in m.
        visible: [A, F], visible share of the sign.
    """
    detected = confidence > stopping.THRESHOLD
    confirmed_m = stopping.first(stopping.confirmed(detected), distance_m)
    return {
        "confidence_mean": confidence.mean(1),
        "confidence_median": np.median(confidence, 1),
        "detection_rate": detected.mean(1),
        "first_seen_m": stopping.first(detected, distance_m),
        "confirmed_m": confirmed_m,
        "overrun_m": stopping.overrun_m(confirmed_m),
        "ran": stopping.ran(confirmed_m),
        "visible_share": visible.mean(1),
        "frame_distance_m": distance_m,
        "frame_confidence": confidence,
        "frame_visible": visible,
    }


def check_approaches(approaches: Sequence[Approach], seeds: range, world: str) -> None:
    """Raise ValueError unless there is one approach per seed, all have the same number of frames, and the farthest is first."""
    if [approach.seed for approach in approaches] != list(seeds):
        raise ValueError(f"{world}.approaches gave seeds {[a.seed for a in approaches]}, asked for {list(seeds)}")
    if len({len(approach.scenes) for approach in approaches}) != 1:
        raise ValueError(f"{world}.approaches gave approaches of different numbers of frames")
    if any((approach.scenes.distance.diff() >= 0).any() for approach in approaches):
        raise ValueError(f"{world}.approaches gave frames that are not in order, farthest first")
