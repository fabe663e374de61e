"""Detectors that learn from windows of the camera world's training scenes, some of them with decoys: what their recipes share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

import torch
from torch import Tensor
from torch.optim.swa_utils import update_bn

from cavbench import zoo
from cavbench.core.contracts import Progress, Trained
from cavbench.core.ranges import Count, Natural, Positive, Share
from cavbench.detection import CameraWorld, Detector, DetectorVictim
from cavbench.detection.victims.checkpoint import Checkpoint
from cavbench.detection.victims.examples import Example, Examples
from cavbench.detection.victims.training import descend
from cavbench.detection.victims.windows import Windows

Network = TypeVar("Network", bound=Detector)

ZOOM = (0.6, 1.2)
"""Smallest and largest side of a training window in the image, as multiples of `window`."""
CALIBRATION = 40
"""Batches for computing the statistics of the batch normalisations after the training."""
KEPT_EVERY = 100
"""Updates between two writes of an unfinished training."""
STRIDE = 32
"""The side of a window is a multiple of it."""


@dataclass(frozen=True, kw_only=True)
class Learner(DetectorVictim, Generic[Network]):
    """A detector with random weights at first.

    Args:
        trained: training seed of the zoo's detector; the seeds of a run are patch seeds.
        updates: number of weight updates in training.
        batch: windows per update.
        window: side of a window in pixels, a multiple of 32.
        away: share of the windows at uniformly random places; the others are near the sign.
        decoys: share of the windows with a decoy in the place of the stop sign.
        learning_rate: maximum learning rate of AdamW.
        trained_in: non-default parameters of the training world; set by `bench train`.
    """

    learns: ClassVar[bool] = True
    decay: ClassVar[float] = 0.998
    """Decay of the average of the weights, per update; a short training needs a faster one, to forget its random weights."""

    trained: Natural = 0
    updates: Count = 2400
    batch: Count = 12
    window: int = 320
    away: Share = 0.5
    decoys: Share = 0.4
    learning_rate: Positive = 2e-3
    trained_in: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window < STRIDE or self.window % STRIDE:
            raise ValueError(f"window must be a multiple of {STRIDE}, got {self.window}")

    @property
    def care(self) -> float:
        """How much more adversarial training weighs a stop sign that is not there, so that it keeps what this training taught."""
        return 1.0

    @abstractmethod
    def begun(self, names: tuple[str, ...]) -> Network:
        """The network with random weights, for these classes."""

    @abstractmethod
    def loss(self, network: Network, example: Example) -> Tensor:
        """What an update lowers."""

    def train(self, world: CameraWorld, *, seed: int, progress: Progress) -> Trained[Detector]:
        """Train a detector on windows of the training scenes, with all objects in them as targets.

        A training that was stopped goes on where it was last kept.
        """
        scenes = world.training_scenes()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = self.begun(world.classes).train()
            generator = torch.Generator().manual_seed(seed)
            windows = Windows(scenes, self.window, zoom=ZOOM, away=self.away, generator=generator)

            def restore(held: Mapping[str, Any]) -> None:
                generator.set_state(held["generator"])

            examples = Examples(scenes, windows, network.index, decoys=self.decoys, generator=generator)
            trained, seconds = descend(
                network,
                lambda update: self.loss(network, examples.draw(self.batch)),
                updates=self.updates,
                learning_rate=self.learning_rate,
                decay=self.decay,
                progress=progress,
                checkpoint=Checkpoint(
                    zoo.unfinished(zoo.Recipe.of(self), seed),
                    KEPT_EVERY,
                    held=lambda: {"generator": generator.get_state()},
                    restore=restore,
                ),
            )
            # The averaged weights need their own batch-norm statistics.
            update_bn((examples.draw(self.batch).pictures for _ in range(CALIBRATION)), trained)
        card = {"frames": len(scenes), "cpu_seconds": round(seconds)}
        return Trained(trained.eval().requires_grad_(False), card)
