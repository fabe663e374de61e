"""The detection track: a detector that looks for a stop sign, which a patch on the sign hides."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import pyarrow as pa

from bench.plugins import registry
from bench.plugins.contracts import Progress
from bench.plugins.pair import Pair, choose
from bench.plugins.track import Driven, Job, Measure, Track
from bench.records.schema import FLOAT, PROBES, TEXT, field

REFERENCE_PATCHES = ("noise_patch", "grey_patch")
"""Patches that know nothing of the detector: what part of an attack is only that the sign is covered."""

MEASUREMENTS: tuple[pa.Field, ...] = (
    field("location", TEXT, "of the approach"),
    field(
        "confidence_mean",
        FLOAT,
        "in the sign at its true place, mean over the frames; 0 in a frame that misses it",
        "0 to 1",
    ),
    field("confidence_median", FLOAT, "the same, median over the frames", "0 to 1"),
    field("detection_rate", FLOAT, "frames with a confidence above 0.25", "share, 0 to 1"),
    field("first_seen_m", FLOAT, "distance at which it is first detected; 0 if it never is", "m"),
    field("confirmed_m", FLOAT, "distance at which it is detected in 3 of the last 5 frames; 0 if it never is", "m"),
    field("overrun_m", FLOAT, "how far beyond the line the car stops; 0 if before it", "m"),
    field("ran", pa.bool_(), "the car never braked for the sign, or stopped more than 1 m beyond the line"),
    field("visible_share", FLOAT, "of the sign, mean over the frames: in the picture and not hidden", "share, 0 to 1"),
    field("false_alarms", FLOAT, "stop signs detected where there is none, mean over the frames", "detections"),
    field("queries", FLOAT, "pictures the detector was asked about to craft the patch", "pictures"),
    field("gradients", FLOAT, "pictures whose gradient was taken to craft the patch", "pictures"),
    field("crafting_s", FLOAT, "wall time of crafting the patch", "s"),
    field("excess", FLOAT, "farthest the attack's own texels were outside [0, 1]", "texel value"),
    field("patch", TEXT, "fingerprint of the patch, patches/<this>.safetensors; empty where there is none"),
    field("patch_sha256", TEXT, "of its texels; empty where it leaves the sign alone"),
    field("frame_distance_m", pa.list_(FLOAT), "of each frame, from the camera to the sign", "m"),
    field("frame_confidence", pa.list_(FLOAT), "of each frame, in the sign at its true place", "0 to 1"),
    field("frame_visible", pa.list_(FLOAT), "of each frame, share of the sign to be seen", "share, 0 to 1"),
)


class DetectionTrack(Track):
    """Detectors of a stop sign, attacked by a patch on it, ranked by their mean confidence in the sign."""

    name: ClassVar[str] = "detection"
    world: ClassVar[str] = "camera"
    victim: ClassVar[str] = "yolov5"
    episode: ClassVar[tuple[str, str]] = ("approach", "approaches")
    run: ClassVar[str] = "patch seed"
    artefact: ClassVar[tuple[str, str] | None] = ("patch", "patches")

    unrepeatable: ClassVar[tuple[str, ...]] = ("patch",)
    measurements: ClassVar[tuple[pa.Field, ...]] = MEASUREMENTS
    probes: ClassVar[tuple[pa.Field, ...]] = PROBES
    metric: ClassVar[str] = "confidence_mean"
    metric_title: ClassVar[str] = "confidence"
    failure: ClassVar[str] = "ran"
    measures: ClassVar[tuple[Measure, ...]] = (
        Measure(column="detection_rate", heading="frames\nseen", unit="share"),
        Measure(column="first_seen_m", heading="first\nseen m", spare=2),
        Measure(column="ran", heading="runs the\nsign", how="rate", unit="share"),
        Measure(column="overrun_m", heading="overrun\nm", digits=1, spare=3),
        Measure(column="visible_share", heading="visible", unit="share", spare=5),
        Measure(column="false_alarms", heading="false alarms\na frame", digits=2, spare=7),
        Measure(column="queries", heading="pictures\na patch", of_attack=True, spare=4),
        Measure(column="crafting_s", heading="crafting\ns", of_attack=True, spare=6),
    )
    legend: ClassVar[str] = (
        "confidence: in the stop sign at its true place, mean over an approach, 0 in a frame that misses it. frames seen: "
        "confidence above 0.25. runs the sign: the car, at 10 m/s, never brakes or stops more than 1 m beyond the line."
    )
    baseline_titles: ClassVar[Mapping[str, str]] = {"noise_patch": "noise patch", "grey_patch": "grey patch"}
    facts_of_v1: ClassVar[Mapping[str, object]] = {
        "decision_hz": 0,
        "max_steps": 0,
        "actions": [],
        "axes": [
            {"name": "lanes", "kind": "int", "meaning": "number of lanes", "choices": [3, 4, 5]},
            {"name": "density", "kind": "float", "meaning": "density of the cars", "choices": [1.0, 2.0]},
            {
                "name": "weather",
                "kind": "str",
                "meaning": "the air and the light",
                "choices": ["clear", "rain", "fog", "night"],
                "default": "clear",
                "perceptual": True,
            },
        ],
    }

    work: ClassVar[str] = "bench.detection.drive"
    preparation: ClassVar[str] = "bench.detection.crafting"

    def baselines(self, pair: Pair) -> Iterator[Pair]:
        """The patches that know nothing, of the same size, on the same defended detector."""
        installed = registry.names("attack") if not pair.is_clean else []
        for name in REFERENCE_PATCHES:
            if name in installed and name != pair.attack.name:
                yield replace(pair, attack=choose("attack", name))

    def baseline_of(self, other: Mapping[str, object], own: Mapping[str, object]) -> str:
        same = ("defense", "defense_params", "victim", "victim_params", "world", "world_params", "threat_budget")
        is_one = other["attack"] in REFERENCE_PATCHES and all(other[name] == own[name] for name in same)
        return str(other["attack"]) if is_one else ""

    def prepare(self, job: Job, made_by: str, progress: Progress) -> bytes:
        from bench.detection.crafting import prepare

        return prepare(job, made_by, progress)

    def drive(self, job: Job, artefact: bytes | None, traced: Sequence[int]) -> Driven:
        from bench.detection.drive import drive

        return drive(job, artefact, traced)

    def record(self, job: Job, trace: Any, meta: Mapping[str, object], path: Path) -> None:
        from bench.recording.detection import save

        save(trace, meta=meta, path=path)
