"""The base classes of the detection track: world, victim, attack and defence of a stop-sign detector."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from torch import Tensor

from cavbench.core.contracts import Attack, Defense, Facts, Progress, ThreatModel, Trained, Victim, World
from cavbench.detection.access import PatchOracle
from cavbench.detection.detector import STOP_SIGN, Detector
from cavbench.detection.scenes import Approach, Scenes
from cavbench.detection.threat import PatchThreat
from cavbench.scenarios import Cell

if TYPE_CHECKING:
    from cavbench.detection.closed_loop import DrivingEnv


class CameraWorld(World):
    """Rendered streets with a stop sign. Attacks and trainings never see the scored approaches."""

    track: ClassVar[str] = "detection"
    locations: ClassVar[tuple[str, ...]]
    """Names of the places; scenario seed s is driven at `locations[s % len(locations)]`. If nothing but the place depends on the
    seed, `scenarios` returns their number."""
    redraws: ClassVar[bool] = False
    mounts: ClassVar[bool] = False
    """Whether its scenes show patches of other shapes and places, too (`Scenes.mounted`)."""
    classes: ClassVar[tuple[str, ...]] = (STOP_SIGN,)
    """Names of the object classes in its scenes (`Scenes.objects`)."""

    @abstractmethod
    def training_scenes(self) -> Scenes:
        """The scenes for crafting patches and training detectors; nothing else may be used."""

    @abstractmethod
    def approaches(self, cell: Cell, seeds: range) -> list[Approach]:
        """One held-out approach per seed, all with the same number of frames.

        Args:
            cell: lanes (lateral distance to the sign), traffic density (cars may hide the sign), weather.
            seeds: scenario seeds.
        """

    def environment(self, cell: Cell, seeds: Sequence[int], patch: Tensor | None, share: float) -> DrivingEnv | None:
        """One car that drives up to a sign, for the closed loop (`cavbench.detection.closed_loop`); None if the world has none.

        Args:
            cell: the cell.
            seeds: scenario seeds; each is a draw of the cross traffic.
            patch: [3, P, P] on the sign; None for no patch.
            share: side of the patch as a share of the sign's side.
        """
        return None

    def render(self, out: Path | None, progress: Progress) -> list[Path]:
        """Render the frames of this world and return the files; an interrupted rendering is resumed.

        Args:
            out: output folder; None for the world's own folder.
            progress: called with the finished share and the name of the current part.
        """
        raise NotImplementedError(f"{type(self).__name__} has nothing to render")


class DetectorVictim(Victim):
    """A kind of detector; the fields of the dataclass are its parameters."""

    track: ClassVar[str] = "detection"
    network: ClassVar[type[Any]] = Detector
    threat: ClassVar[type[ThreatModel]] = PatchThreat

    @property
    def seeded(self) -> bool:
        """Whether the detector depends on the training seed; if not, the seeds of a run are patch seeds only."""
        return False

    def alternatives(self) -> Mapping[str, DetectorVictim]:
        """The same victim with other parameters that could be meant, by the words to type; for a hint if it sees no sign."""
        return {}

    @abstractmethod
    def load(self, seed: int, facts: Facts) -> Detector:
        """The detector of training seed `seed`, in eval mode, without gradients on its weights.

        Args:
            seed: training seed.
            facts: facts of the world in which it will be used.

        Raises:
            UserError: if its weights are missing or have the wrong hash.
        """

    def train(self, world: CameraWorld, *, seed: int, progress: Progress) -> Trained[Detector]:
        """Train a detector on the training scenes of a world."""
        raise NotImplementedError(f"{type(self).__name__} does not learn")


class DetectorDefense(Defense):
    """Protects a detector. `train(victim, world, seed, progress)` may look at `world.training_scenes()` only."""

    track: ClassVar[str] = "detection"

    @abstractmethod
    def load(self, victim: DetectorVictim, seed: int, facts: Facts) -> Detector:
        """The defended detector: adversarially trained and loaded from the zoo, or wrapped to transform its input.

        A transformation without a useful gradient should use a straight-through one (Athalye et al. 2018): obfuscated
        gradients are no evidence of robustness.
        """


class PatchAttack(Attack):
    """Crafts one patch for the middle of the sign on training scenes; the patch is scored on held-out approaches."""

    track: ClassVar[str] = "detection"
    seeded: ClassVar[bool] = True
    """Whether its patch depends on the patch seed; if not, it is crafted for one seed only."""

    @abstractmethod
    def craft(self, oracle: PatchOracle, scenes: Scenes, progress: Progress) -> Tensor | None:
        """The patch [3, P, P] sRGB in [0, 1], P from 8 to 512; None for no patch.

        Its side is `oracle.threat.budget` times the sign's: pass it to `scenes.render` as `share`.

        Args:
            oracle: the only access to the detector; it holds the label to hide (`label`), the query budget (`remaining`) and
                the random generator (`generator`), and records intermediate patches (`report`).
            scenes: the scenes to craft on.
            progress: called with the finished share.
        """
