"""The base classes of the detection track: World, Victim, Attack and Defense of a detector that looks for a stop sign."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor

from bench.detection.detector import STOP_SIGN, Detector
from bench.detection.oracle import PatchOracle
from bench.detection.scenes import Approach, Scenes
from bench.detection.threat import PatchThreat
from bench.plugins.contracts import Attack, Defense, Facts, Progress, ThreatModel, Trained, Victim, World
from bench.scenarios import Cell


class CameraWorld(World):
    """Streets with a stop sign, rendered. What is scored is never shown to anyone who crafts or trains."""

    track: ClassVar[str] = "detection"
    locations: ClassVar[tuple[str, ...]]
    """Names of the places; scenario seed s is driven at `locations[s % len(locations)]`."""
    classes: ClassVar[tuple[str, ...]] = (STOP_SIGN,)
    """Of what there is to find in its scenes (`Scenes.objects`)."""

    @abstractmethod
    def training_scenes(self) -> Scenes:
        """All that crafting a patch or hardening a detector may look at."""

    @abstractmethod
    def approaches(self, cell: Cell, seeds: range) -> list[Approach]:
        """One held-out approach a seed, all of the same number of frames.

        Args:
            cell: lanes (how far the sign stands from the ego's), traffic density (cars, which may hide it), weather.
            seeds: scenario seeds.
        """

    def render(self, out: Path | None, progress: Progress) -> list[Path]:
        """Make the frames of this world anew, going on where it was broken off, and return the files.

        Args:
            out: folder for them; None for the world's own.
            progress: called with the share done and what is being rendered.
        """
        raise NotImplementedError(f"{type(self).__name__} has nothing to render")


class DetectorVictim(Victim):
    """A kind of detector; the fields of the dataclass are its parameters."""

    track: ClassVar[str] = "detection"
    network: ClassVar[type[Any]] = Detector
    threat: ClassVar[type[ThreatModel]] = PatchThreat

    @property
    def seeded(self) -> bool:
        """Whether `load` gives another detector for another seed; one that does not leaves the seeds of a run to the patches."""
        return False

    @abstractmethod
    def load(self, seed: int, facts: Facts) -> Detector:
        """The detector of training seed `seed`, in eval mode, without gradients on its weights.

        Args:
            seed: training seed.
            facts: of the world it is going to be used in.

        Raises:
            UserError: if its weights are not there or not what they should be.
        """

    def train(self, world: CameraWorld, *, seed: int, progress: Progress) -> Trained[Detector]:
        """Train a detector on the training scenes of a world."""
        raise NotImplementedError(f"{type(self).__name__} does not learn")


class DetectorDefense(Defense):
    """Protects a detector. `train(victim, world, seed, progress)` may look at `world.training_scenes()` only."""

    track: ClassVar[str] = "detection"

    @abstractmethod
    def load(self, victim: DetectorVictim, seed: int, facts: Facts) -> Detector:
        """The defended detector: hardened, from the zoo, or one that transforms the pictures first.

        A transformation without a useful gradient should have a straight-through one (Athalye et al. 2018): an attack that
        runs into a wall by accident proves nothing.
        """


class PatchAttack(Attack):
    """Makes a patch for the middle of the sign, once, from training scenes; it is scored on approaches it never saw."""

    track: ClassVar[str] = "detection"
    seeded: ClassVar[bool] = True
    """Whether its patch depends on the patch seed; one that does not is crafted for one seed only."""

    @abstractmethod
    def craft(self, oracle: PatchOracle, scenes: Scenes, progress: Progress) -> Tensor | None:
        """The patch [3, P, P] sRGB in [0, 1], P from 8 to 512; None leaves the sign alone.

        Its width is `oracle.threat.budget` times the sign's: what `scenes.render` takes as `share`.

        Args:
            oracle: the only door to the detector; it holds the label to hide (`label`), the query budget (`remaining`) and the
                random generator (`generator`), and can be shown how the patch comes about (`report`).
            scenes: to craft on.
            progress: told how far it is.
        """
