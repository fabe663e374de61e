"""Whether a detector knows the stop sign: what it says of the sign, beside what it says of decoys in the sign's place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cavbench.detection import stopping
from cavbench.detection.precision import VISIBLE, precision_of_approach
from cavbench.detection.scenes import FAMILIES, FOREIGN, Scenes
from cavbench.detection.sight import Sight
from cavbench.errors import UserError

ROUNDING = 1e-3
"""A confidence may be this much below its certificate: sums in another order."""


def discrimination(
    seen: Sequence[Sight], decoys: Sequence[Sight | None], scenes: Sequence[Scenes]
) -> dict[str, NDArray[np.generic]]:
    """The measurements of A approaches with decoys, [A] each; all but `stop_score` are NaN where the world has no decoys.

    `stop_score` is the discrimination slope of Yates (1982, "External correspondence"), the mean confidence in the sign minus the
    mean confidence in the decoys, not below 0. A detector that says "stop" more often raises both.

    Args:
        seen: the output with the sign, which may have a patch.
        decoys: the output with decoys; None where the world has none.
        scenes: the frames.
    """
    rows = [_of_approach(*each) for each in zip(seen, decoys, scenes, strict=True)]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _of_approach(seen: Sight, decoys: Sight | None, scenes: Scenes) -> dict[str, float]:
    confidence = float(seen.confidence.mean(dtype=np.float64))
    if decoys is None:
        missing = dict.fromkeys(("average_precision", "decoy_confidence", "false_stops", "octagons"), np.nan)
        return {"stop_score": confidence, **missing}
    of_decoys = float(decoys.confidence.mean(dtype=np.float64))
    octagonal = np.array([decoy.octagonal for decoy in scenes.decoys]) & (scenes.visible >= VISIBLE).numpy()
    taken = decoys.confidence[octagonal] > stopping.THRESHOLD
    return {
        "stop_score": max(0.0, confidence - of_decoys),
        "average_precision": precision_of_approach(seen.candidates, decoys.candidates, scenes.boxes, scenes.visible),
        "decoy_confidence": of_decoys,
        "false_stops": float(np.mean([len(one.scores) for one in decoys.found])),
        "octagons": float(taken.mean()) if len(taken) else np.nan,
    }


def stops_by_family(faces: Sequence[Sight | None], scenes: Sequence[Scenes]) -> dict[str, NDArray[np.generic]]:
    """What is detected on faces that no training sees, [A] each; NaN where an approach shows none of a family.

    Args:
        faces: the output with these faces; None where the world has none.
        scenes: the frames.
    """
    rows = [_of_faces(*each) for each in zip(faces, scenes, strict=True)]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _of_faces(sight: Sight | None, scenes: Scenes) -> dict[str, float]:
    families = np.array([one.family for one in scenes.faces] if sight else [])
    stops = np.array([len(one.scores) for one in sight.found] if sight else [])
    seen = sight.confidence > stopping.THRESHOLD if sight else np.array([])
    foreign = families == FOREIGN
    if sight:
        foreign &= (scenes.visible >= VISIBLE).numpy()
    return {
        "false_stops_faces": _mean(stops[np.isin(families, FAMILIES)]),
        **{f"false_stops_{family}": _mean(stops[families == family]) for family in FAMILIES},
        "foreign_stops": _mean(seen[foreign]),
    }


def certified(
    least: Sequence[NDArray[np.float32] | None], seen: Sequence[Sight], decoys: Sequence[Sight | None]
) -> dict[str, NDArray[np.generic]]:
    """The certificate of A approaches: `stop_score` with the certified confidence in the sign, and this of each frame, [A] lists.

    They are NaN and None without a certificate. No patch lowers the confidence below the certificate, and decoys carry none, so
    `stop_score` is at least this.

    Args:
        least: the certified confidence in each frame; None without a certificate.
        seen: the output with the sign, which may have a patch.
        decoys: the output with decoys; None where the world has none.

    Raises:
        UserError: if the confidence is below the certificate in a frame.
    """
    found, frames = [], np.full(len(least), None, object)
    for place, (certain, sight, other) in enumerate(zip(least, seen, decoys, strict=True)):
        if certain is None:
            found.append(np.nan)
            continue
        frames[place] = certain.astype(np.float64).tolist()
        if (short := float((certain - sight.confidence).max())) > ROUNDING:
            raise UserError(f"the certificate is false: the confidence in a frame is {short:.3f} below it")
        of_decoys = 0.0 if other is None else float(other.confidence.mean(dtype=np.float64))
        found.append(max(0.0, float(certain.mean(dtype=np.float64)) - of_decoys))
    return {"certified": np.array(found), "frame_certified": frames}


def if_visible(seen: Sequence[Sight], scenes: Sequence[Scenes]) -> dict[str, NDArray[np.generic]]:
    """What is seen of the sign in the frames that show at least half of it, [A] each; NaN and "" where no frame does.

    Args:
        seen: the output with the sign.
        scenes: the frames.
    """
    rows = []
    for sight, one in zip(seen, scenes, strict=True):
        shown = (one.visible >= VISIBLE).numpy()
        names = [name for name, there in zip(sight.others, shown, strict=True) if name and there]
        rows.append((_mean(sight.confidence[shown]), _mean(np.array(sight.others)[shown] != ""), _commonest(names)))
    confidence, misread, instead = zip(*rows, strict=True)
    return {
        "confidence_visible": np.array(confidence),
        "misread": np.array(misread),
        "seen_instead": np.array(instead),
    }


def _commonest(names: Sequence[str]) -> str:
    return max(sorted(set(names)), key=names.count, default="")


def _mean(values: NDArray[np.generic]) -> float:
    return float(values.mean(dtype=np.float64)) if len(values) else np.nan
