"""Temporal fusion of detections: the evidence for a stop sign is added up over the frames of an approach."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from annotated_types import Interval
from torch import Tensor

from cavbench.core.contracts import Facts
from cavbench.core.ranges import NotNegative, Positive
from cavbench.detection import STOP_SIGN, Detector, DetectorDefense, DetectorVictim, Predictions, Wrapped
from cavbench.detection.boxes import detections, overlap
from cavbench.detection.evidence import log_odds

SINGLE = 0.2
"""Score after one frame with the greatest evidence: below `cavbench.detection.stopping.THRESHOLD`, so one does not count."""
HIGHEST = 0.97
"""Highest score of a track, with log-odds of 3.5: OctoMap's upper clamp (Hornung et al. 2013)."""
MATCH_IOU, MERGE_IOU = 0.3, 0.45
"""A prediction belongs to a track from this IoU with the track's place on; tracks with a greater IoU than the second are one."""
LEAST_SCORE = 0.01
"""Predictions with a lower score are not looked at."""
NEAREST_M = 1.0
"""Objects are taken to be at least this far away."""


@dataclass(frozen=True)
class Tracks:
    """What is remembered of T possible stop signs.

    Args:
        boxes: [T, 4] in pixels of the last frame.
        odds: [T] log-odds.
    """

    boxes: Tensor
    odds: Tensor

    def where(self, chosen: Tensor) -> Tracks:
        """The tracks with these indices, or for which this is true."""
        return Tracks(self.boxes[chosen], self.odds[chosen])


class Fused(Wrapped):
    """A detector whose scores of a stop sign are those of tracks; other classes are left alone.

    Args:
        inner: the detector.
        recipe: the parameters.
    """

    def __init__(self, inner: Detector, recipe: TemporalFusion) -> None:
        super().__init__(inner)
        self.recipe, self.label = recipe, inner.index(STOP_SIGN)

    def predict(self, pictures: Tensor) -> Predictions:
        return self.inner.predict(pictures)

    def initial(self) -> Any:
        return self.inner.initial(), Tracks(torch.zeros(0, 4), torch.zeros(0))

    def advance(self, predictions: Predictions, moved_m: Tensor, state: Any) -> tuple[Predictions, Any]:
        before, tracks = state
        predictions, after = self.inner.advance(predictions, moved_m, before)
        reported = []
        for number, moved in enumerate(moved_m.tolist()):
            tracks = self._seen(predictions, number, Tracks(self.moved(tracks.boxes, moved), tracks.odds))
            reported.append(tracks)
        return self._reported(predictions, reported), (after, tracks)

    def aggregate(self, scores: Tensor) -> Tensor:
        evidence = self.evidence(self.inner.aggregate(scores))
        odds = torch.full_like(evidence[..., 0], self.recipe.floor)
        reported = []
        for each in evidence.unbind(-1):
            odds = self.added(odds, each)
            reported.append(odds)
        return torch.stack(reported, -1).sigmoid()

    def evidence(self, scores: Tensor) -> Tensor:
        """The evidence of scores in [0, 1], in log-odds; the gradient is that without clipping."""
        odds = log_odds(scores) - math.log(self.recipe.neutral / (1 - self.recipe.neutral))
        return straight_through(odds, -self.recipe.miss, self.recipe.hit)

    def added(self, odds: Tensor, evidence: Tensor) -> Tensor:
        """The log-odds after a frame, clamped (Hornung et al. 2013); the gradient is that without clamping."""
        return straight_through(odds + evidence, self.recipe.floor, math.log(HIGHEST / (1 - HIGHEST)))

    def moved(self, boxes: Tensor, metres: float) -> Tensor:
        """Where the boxes [T, 4] of standing signs are in the image after the car has driven a distance straight ahead.

        The height of a box gives its distance d, as that of a sign of known size. A point moves away from the vanishing point of
        the road by the factor d / (d - metres).
        """
        height = (boxes[:, 3] - boxes[:, 1]).clamp(min=1)
        distance = self.recipe.focal * self.recipe.sign_m / height
        growth = distance / (distance - metres).clamp(min=NEAREST_M)
        vanishing = torch.tensor([self.recipe.vanishing_x, self.recipe.vanishing_y] * 2)
        return vanishing + growth.clamp(min=1)[:, None] * (boxes - vanishing)

    @torch.no_grad()
    def _seen(self, predictions: Predictions, number: int, tracks: Tracks) -> Tracks:
        """The tracks after a frame, best first, from the tracks at their places in it."""
        scores = predictions.objectness[number] * predictions.classes[number, :, self.label]
        (looked_at,) = (scores > LEAST_SCORE).nonzero(as_tuple=True)
        boxes, scores = predictions.boxes[number, looked_at], scores[looked_at]
        matches = scores[:, None] * (overlap(boxes[:, None], tracks.boxes) >= MATCH_IOU)
        # The last row stands for no prediction.
        best, which = torch.cat([matches, torch.zeros(1, len(tracks.odds))]).max(0)
        places = torch.where((best > 0)[:, None], torch.cat([boxes, tracks.boxes[:1]])[which], tracks.boxes)
        old = Tracks(places, self.added(tracks.odds, self.evidence(best)))
        new = self._born(boxes, scores, old)
        both = Tracks(torch.cat([old.boxes, new.boxes]), torch.cat([old.odds, new.odds]))
        return _distinct(both.where(both.odds > self.recipe.floor))

    def _born(self, boxes: Tensor, scores: Tensor, tracks: Tracks) -> Tracks:
        """A track for each predicted box [K, 4] at no track's place."""
        free = ~(overlap(boxes[:, None], tracks.boxes) >= MATCH_IOU).any(1)
        alone = Predictions(boxes[None, free], scores[None, free], torch.ones(1, int(free.sum()), 1))
        (found,) = detections(alone, threshold=LEAST_SCORE, iou=MERGE_IOU)
        start = torch.full_like(found.scores, self.recipe.floor)
        return Tracks(found.boxes, self.added(start, self.evidence(found.scores)))

    def _reported(self, predictions: Predictions, tracks: list[Tracks]) -> Predictions:
        """The predictions with the tracks in place of the stop signs of single frames; missing tracks have score 0."""
        frames, most = len(tracks), max([len(one.odds) for one in tracks], default=0)
        boxes, scores = torch.zeros(frames, most, 4), torch.zeros(frames, most)
        for number, one in enumerate(tracks):
            boxes[number, : len(one.odds)], scores[number, : len(one.odds)] = one.boxes, one.odds.sigmoid()
        others, signs = predictions.classes.clone(), torch.zeros(frames, most, len(self.names))
        others[..., self.label], signs[..., self.label] = 0, 1
        return Predictions(
            torch.cat([predictions.boxes, boxes], 1),
            torch.cat([predictions.objectness, scores], 1),
            torch.cat([others, signs], 1),
        )


def _distinct(tracks: Tracks) -> Tracks:
    """The tracks, surest first, without those at the place of a surer one."""
    tracks = tracks.where(tracks.odds.argsort(descending=True, stable=True))
    same = (overlap(tracks.boxes[:, None], tracks.boxes) > MERGE_IOU).tril(-1).any(1)
    return tracks.where(~same)


def straight_through(values: Tensor, low: float, high: float) -> Tensor:
    """Values clipped to [low, high], with the gradient of the values (BPDA, Athalye et al. 2018)."""
    return values + (values.clamp(low, high) - values).detach()


@dataclass(frozen=True, kw_only=True)
class TemporalFusion(DetectorDefense):
    """Temporal fusion: a binary Bayes filter with clamped log-odds for each sign that is tracked over the frames of an approach.

    The filter is that of an occupancy grid (Thrun, Burgard and Fox 2005, section 4.2) with the clamping of OctoMap (Hornung et
    al. 2013), for the hypothesis "there is a stop sign here". A sign's place in the next frame follows from the distance driven.
    A hit counts more than a miss, so a sign that was seen twice is not forgotten at once; a single frame is not enough. Nothing
    is trained.

    Args:
        hit: greatest evidence of a frame for a sign, in log-odds.
        miss: greatest evidence of a frame against it, in log-odds; 0: never forgotten.
        neutral: score of a frame that is no evidence, in (0, 1).
        sign_m: width of a stop sign in m.
        focal: focal length in pixels.
        vanishing_x, vanishing_y: where points straight ahead are in the image, in pixels.
    """

    hit: Positive = 2.5
    miss: NotNegative = 0.4
    neutral: Annotated[float, Interval(ge=LEAST_SCORE, lt=1)] = 0.15
    sign_m: Positive = 1.2
    focal: Positive = 721.0
    vanishing_x: float = 624.0
    vanishing_y: float = 204.6

    @property
    def floor(self) -> float:
        """Least log-odds, with which a track begins and ends: the greatest evidence of one frame leads to `SINGLE`."""
        return math.log(SINGLE / (1 - SINGLE)) - self.hit

    def load(self, victim: DetectorVictim, seed: int, facts: Facts) -> Detector:
        return self.around(victim.load(seed, facts))

    def around(self, detector: Detector) -> Fused:
        """The defended detector."""
        return Fused(detector, self).eval()
