"""One episode of a trace as arrays over its steps, in physical units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from bench.driving import DrivingFacts, Features, ObservationThreat
from bench.driving.rollout import Trace

CONTROLS = ("acceleration", "steering")
"""What a continuous action sets, in [-1, 1]."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Episode:
    """The running steps of one episode.

    Args:
        steps: arrays [T, ...] by name, as `bench.driving.rollout.Trace` has them, without the batch dimension.
        facts: of the world.
        meta: the record of the episode (`bench.records.store.SCHEMA`), as far as it is known.
    """

    steps: Mapping[str, NDArray[np.generic]]
    facts: DrivingFacts
    meta: Mapping[str, object]

    @classmethod
    def of(cls, trace: Trace, facts: DrivingFacts, meta: Mapping[str, object]) -> Episode:
        """The one episode of a trace, up to its end.

        Raises:
            ValueError: unless the trace holds exactly one episode with at least one step.
        """
        if len(trace.episodes) != 1 or not trace.steps.get("running"):
            raise ValueError(
                f"a recording needs one episode with at least one step, got {len(trace.episodes)} episodes"
            )
        running = np.stack(trace.steps["running"])[:, 0].astype(bool)
        return cls({name: np.stack(steps)[running, 0] for name, steps in trace.steps.items()}, facts, meta)

    def __len__(self) -> int:
        return len(self.steps["running"])

    @property
    def timelines(self) -> dict[str, NDArray[np.generic]]:
        """`step`, and `time` in seconds."""
        steps = np.arange(len(self))
        return {"step": steps, "time": steps / self.facts.decision_hz}

    @property
    def features(self) -> Features:
        """Of the observation."""
        return self.facts.features

    @property
    def seconds(self) -> float:
        """How long it is."""
        return len(self) / self.facts.decision_hz

    @property
    def discrete(self) -> bool:
        """Whether the actions are lane-changing decisions, not accelerations and steering angles."""
        return bool(self.steps["action"].ndim == 1)

    @property
    def attacked(self) -> bool:
        """Whether the policy was ever shown anything but what was measured."""
        return not np.array_equal(self.steps["observation"], self.steps["perturbed"])

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """[T, V - 1] the rows that hold another vehicle."""
        return np.asarray(self.steps["observation"][:, 1:, 0], dtype=np.float64) > 0

    def physical(self, name: str, feature: str) -> Array:
        """[T, V] a feature of `observation` or `perturbed`, in its own unit."""
        place = self.features.names.index(feature)
        low, high = self.features.low[place], self.features.high[place]
        normalised = np.asarray(self.steps[name][:, :, 1 + place], dtype=np.float64)
        return normalised * (high - low) / 2 + (high + low) / 2

    def moved(self, feature: str) -> Array:
        """[T] the largest deviation of a feature of any vehicle, in the feature's unit."""
        return np.abs(self.physical("perturbed", feature) - self.physical("observation", feature)).max(1)

    @cached_property
    def budget(self) -> dict[str, Array]:
        """[T] by feature: the largest deviation the threat model allows of any vehicle, in the feature's unit."""
        known = {name: self.meta[f"threat_{name}"] for name in ("norm", "budget") if f"threat_{name}" in self.meta}
        threat = ObservationThreat(**known)  # type: ignore[arg-type]
        radius = threat.radius(torch.as_tensor(self.steps["observation"]), self.features)[..., 1:]
        physical = (radius * self.features.half_range()).amax(1).double().numpy()
        return dict(zip(self.features.names, physical.T, strict=True))

    @property
    def choices(self) -> tuple[NDArray[np.generic], NDArray[np.generic]]:
        """The action on what was measured and the action taken: int64 [T], or [T, 2] in [-1, 1]."""
        clean = np.asarray(self.steps["clean_scores"])
        return (clean.argmax(-1) if self.discrete else clean), np.asarray(self.steps["action"])

    @property
    def end(self) -> str:
        """How the episode ended."""
        if self.steps["crashed"][-1]:
            return "crashed"
        return "left the road" if self.steps["offroad"][-1] else "drove to the end"
