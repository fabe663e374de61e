"""One episode of a trace as arrays over its steps, in physical units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from cavbench.core import sets
from cavbench.driving import DrivingFacts, Features, ObservationThreat
from cavbench.driving.rollout import Trace

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Episode:
    """The running steps of one episode.

    Args:
        steps: arrays [T, ...] by name, as in `cavbench.driving.rollout.Trace` but without the batch dimension.
        facts: facts of the world.
        meta: columns of the episode's record (`cavbench.records.schema.schema`); some may be missing.
    """

    steps: Mapping[str, NDArray[np.generic]]
    facts: DrivingFacts
    meta: Mapping[str, object]

    @classmethod
    def of(cls, trace: Trace, facts: DrivingFacts, meta: Mapping[str, object]) -> Episode:
        """The single episode of a trace, up to its end.

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
        """Features of the observation."""
        return self.facts.features

    @property
    def seconds(self) -> float:
        """Length in seconds."""
        return len(self) / self.facts.decision_hz

    @property
    def discrete(self) -> bool:
        """Whether the actions are discrete lane-changing decisions instead of acceleration and steering."""
        return bool(self.steps["action"].ndim == 1)

    @property
    def attacked(self) -> bool:
        """Whether any observation was perturbed."""
        return not np.array_equal(self.steps["observation"], self.steps["perturbed"])

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """[T, V - 1] whether a row contains another vehicle."""
        return np.asarray(self.steps["observation"][:, 1:, 0], dtype=np.float64) > 0

    @property
    def on_road(self) -> bool:
        """Whether the places of cars are measured; across the road they need not be, where its lanes are known."""
        return "x" in self.features.names and ("y" in self.features.names or bool(self.facts.lanes))

    def physical(self, name: str, feature: str) -> Array:
        """[T, V] a feature of `observation` or `perturbed` (`name`), in its physical unit; a `y` that is not measured is 0."""
        if feature == "y" and "y" not in self.features.names:
            return np.zeros(self.steps[name].shape[:2])
        place = self.features.names.index(feature)
        low, high = self.features.low[place], self.features.high[place]
        normalised = np.asarray(self.steps[name][:, :, 1 + place], dtype=np.float64)
        return normalised * (high - low) / 2 + (high + low) / 2

    def moved(self, feature: str) -> Array:
        """[T] the largest perturbation of a feature over all vehicles, in the feature's unit."""
        return np.abs(self.physical("perturbed", feature) - self.physical("observation", feature)).max(1)

    @cached_property
    def budget(self) -> dict[str, Array]:
        """[T] for each feature: the largest perturbation allowed for any vehicle, in the feature's unit."""
        known = {name: self.meta[f"threat_{name}"] for name in ("norm", "budget") if f"threat_{name}" in self.meta}
        known |= {"norm": sets.split(str(known["norm"]))[0]} if "norm" in known else {}
        threat = ObservationThreat(**known)  # type: ignore[arg-type]
        radius = threat.radius(torch.as_tensor(self.steps["observation"]), self.features)[..., 1:]
        physical = (radius * self.features.half_range()).amax(1).double().numpy()
        return dict(zip(self.features.names, physical.T, strict=True))

    @property
    def choices(self) -> tuple[NDArray[np.generic], NDArray[np.generic]]:
        """The action on the true observation and the action taken: int64 [T], or [T, 2] in [-1, 1]."""
        clean = np.asarray(self.steps["clean_scores"])
        return (clean.argmax(-1) if self.discrete else clean), np.asarray(self.steps["action"])

    @property
    def end(self) -> str:
        """How the episode ended."""
        if self.steps["crashed"][-1]:
            return "crashed"
        return "left the road" if self.steps["offroad"][-1] else "drove to the end"
