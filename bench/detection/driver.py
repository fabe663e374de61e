"""A driver with a memory: it follows detections from frame to frame, confirms what holds together, and brakes to stop there.

The closed-loop form of `cavbench.detection.stopping`, with the same constants. The driver does not know where a sign can be: a
false detection that holds together stops the car as the sign does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import median

from torch import Tensor

from cavbench.detection import stopping
from cavbench.detection.boxes import overlap

SAME_IOU = 0.3
"""A box continues a track if it overlaps the track's last box at least so much: the threshold of SORT (Bewley et al. 2016)."""
NEAREST_M = 1e-3
"""The driver plans for at least this distance, so that it asks for a finite deceleration at and beyond the line."""
MOMENT_S = 1e-4
"""Times that differ by less are the same; sums of steps are rounded."""


@dataclass(frozen=True)
class Track:
    """Something that was detected as a stop sign, followed from frame to frame.

    Args:
        box: [4], where it was last detected, in pixels.
        lines_m: of the last five frames, oldest first: what the car will have driven when it is at the line of this sign, in m,
            by the width of the box; NaN where it was not detected.
        line_m: the middle of these; the last one of a track that was lost.
        since_s: time since it was confirmed; NaN until then. A confirmed sign is not forgotten.
    """

    box: Tensor
    lines_m: tuple[float, ...] = (math.nan,) * stopping.OF_THE_LAST
    line_m: float = math.nan
    since_s: float = math.nan

    @property
    def confirmed(self) -> bool:
        """Whether it was detected in three of five frames."""
        return not math.isnan(self.since_s)

    @property
    def detected(self) -> list[float]:
        """The lines of the last five frames in which it was detected."""
        return [line for line in self.lines_m if not math.isnan(line)]

    def seen(self, box: Tensor | None, line_m: float) -> Track:
        """The track after one more frame; None if it was not detected there."""
        later = replace(self, box=self.box if box is None else box, lines_m=(*self.lines_m[1:], line_m))
        detected = later.detected
        confirms = not self.confirmed and len(detected) >= stopping.CONFIRMED_IN
        return replace(
            later,
            line_m=median(detected) if detected else self.line_m,
            since_s=0.0 if confirms else self.since_s,
        )


@dataclass(frozen=True)
class Memory:
    """What the driver of a car remembers.

    It knows the width of a stop sign and its camera, so the width of a box says how far away the sign is.

    Args:
        sign_px_m: width of a stop sign in the image times its distance, in pixels times m.
        tracks: what it follows, and the signs that it has confirmed.
        frame: number of the last frame; a frame that is shown twice counts once.
        braking: whether it has begun to brake.
    """

    sign_px_m: float
    tracks: tuple[Track, ...] = ()
    frame: int = -1
    braking: bool = False

    @property
    def confirmed(self) -> tuple[Track, ...]:
        """The signs that it has confirmed."""
        return tuple(track for track in self.tracks if track.confirmed)

    def seeing(self, boxes: Tensor, frame: int, driven_m: float) -> Memory:
        """The memory after a look.

        A box continues the track whose last box it overlaps most, by an IoU of at least `SAME_IOU`, as in the tracker of
        Bochinski et al. (2017, "High-speed tracking-by-detection without using image information"), but a track bridges up to
        four frames. Other boxes begin tracks. Three detections in five frames confirm one.

        Args:
            boxes: [M, 4], the detected stop signs, best first, in pixels.
            frame: number of the frame that is seen.
            driven_m: what the car had driven where the image was taken, in m.
        """
        if frame == self.frame:
            return self
        followed = [track for track in self.tracks if track.detected]
        found: dict[int, Tensor] = {}
        begun = []
        for box in boxes:
            shares = [
                -1.0 if number in found else float(overlap(track.box, box)) for number, track in enumerate(followed)
            ]
            best = max(range(len(shares)), key=shares.__getitem__, default=-1)
            if best >= 0 and shares[best] >= SAME_IOU:
                found[best] = box
            else:
                begun.append(Track(box).seen(box, self._line(box, driven_m)))
        later = [
            track.seen(found[number], self._line(found[number], driven_m))
            if number in found
            else track.seen(None, math.nan)
            for number, track in enumerate(followed)
        ]
        kept = [track for track in self.tracks if track.confirmed and not track.detected]
        tracks = (*kept, *(track for track in later if track.confirmed or track.detected), *begun)
        return replace(self, tracks=tracks, frame=frame)

    def _line(self, box: Tensor, driven_m: float) -> float:
        """What the car will have driven when it is at the line of a sign with this box."""
        return driven_m + self.sign_px_m / max(float(box[2] - box[0]), 1.0)

    def deciding(self, driven_m: float, speed_mps: float) -> tuple[float, Memory]:
        """The deceleration in m/s2 that the driver asks for, and its memory with that decision.

        The nearest of the confirmed signs counts for which the reaction time has passed. The driver begins to brake when it must
        brake comfortably or harder to stop at the line of this sign. From then on it asks for the deceleration that stops the car
        there, at least a comfortable one. The brakes limit it.

        Args:
            driven_m: what the car has driven so far, in m.
            speed_mps: its speed.
        """
        lines = [track.line_m for track in self.confirmed if track.since_s >= stopping.REACTION_S - MOMENT_S]
        if not lines:
            return 0.0, self
        needed, least = speed_mps**2 / (2 * max(min(lines) - driven_m, NEAREST_M)), stopping.COMFORTABLE_DECELERATION
        braking = self.braking or needed >= least
        return max(needed, least) if braking else 0.0, replace(self, braking=braking)

    def after(self, seconds: float) -> Memory:
        """The memory some time later."""
        return replace(self, tracks=tuple(replace(track, since_s=track.since_s + seconds) for track in self.tracks))
