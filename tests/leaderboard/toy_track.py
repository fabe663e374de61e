"""A third track as somebody else ships it: balancing a pole. No baselines, no failure, no probes, axes of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import pyarrow as pa

from cavbench.core.track import Driven, Job, Measure, Track
from cavbench.records.schema import FLOAT, field


class BalancingTrack(Track):
    """Controllers that balance a pole, ranked by how long it stays up."""

    name: ClassVar[str] = "balancing"
    world: ClassVar[str] = "pole"
    work: ClassVar[str] = "toy_track_plugin"
    measurements: ClassVar[tuple[pa.Field, ...]] = (
        field("upright", FLOAT, "time that the pole stayed up", "share, 0 to 1"),
        field("swing_deg", FLOAT, "largest angle", "degrees"),
    )
    metric: ClassVar[str] = "upright"
    metric_title: ClassVar[str] = "upright"
    measures: ClassVar[tuple[Measure, ...]] = (Measure(column="swing_deg", heading="swing\ndeg", digits=1),)
    legend: ClassVar[str] = "upright: share of the time that the pole stayed up."

    def drive(self, job: Job, artefact: bytes | None, traced: Sequence[int]) -> Driven:
        raise NotImplementedError("this test reads records, and makes none")
