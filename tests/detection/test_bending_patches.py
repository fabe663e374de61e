"""What a patch attack and a detector may not do unseen: what they are given is their own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from cavbench.core.contracts import Access, Progress
from cavbench.detection import PatchAttack, PatchOracle, Predictions, Scenes
from cavbench.detection.approach import probed
from cavbench.detection.crafting import craft
from cavbench.detection.scenes import Approach
from cavbench.detection.sight import look
from cavbench.detection.threat import PatchThreat
from cavbench.isolation.watch import TamperError
from tests.plugins.toy_camera import RedDetector, RedScenes


@dataclass(frozen=True, kw_only=True)
class Does(PatchAttack):
    """Does what it is given, and makes a loud patch."""

    access: ClassVar[Access] = "oblivious"
    deed: Callable[[PatchOracle, Any], object]

    def craft(self, oracle: PatchOracle, scenes: Scenes, progress: Progress) -> Tensor:
        self.deed(oracle, scenes)
        return torch.linspace(-1, 2, 3 * 64).reshape(3, 8, 8)


def loosen(oracle: PatchOracle, scenes: Any) -> None:
    for name, value in (("norm", "patch"), ("budget", 1.0), ("queries", 10**9)):
        object.__setattr__(oracle.threat, name, value)


def spoil(oracle: PatchOracle, scenes: Any) -> None:
    for values in (scenes.boxes, scenes.red, scenes.distance):
        values.mul_(0)
    scenes.size = (1, 1)


@pytest.mark.parametrize("deed", [loosen, spoil])
def test_what_a_patch_attack_does_to_what_it_is_given_changes_nothing(deed: Callable[..., object]) -> None:
    scenes, threat = Pictured(torch.linspace(8, 30, 12)), PatchThreat(norm="print")
    before = scenes.boxes.clone(), scenes.red.clone(), repr(threat)
    found, honest = (
        craft(Does(deed=one), RedDetector(), scenes, threat, attack_seed=0, progress=lambda share, text: None).texels
        for one in (deed, lambda oracle, scenes: None)
    )
    assert found is not None
    assert honest is not None
    assert torch.equal(found, honest)
    assert torch.equal(scenes.boxes, before[0])
    assert torch.equal(scenes.red, before[1])
    assert repr(threat) == before[2]


class Pictured(RedScenes):
    """Scenes that keep their pictures in a tuple."""

    def __init__(self, distance: Tensor) -> None:
        super().__init__(distance)
        self.boxes = self.boxes.clone()
        self.pictures = (np.zeros(8), np.zeros((512, 512), np.float64))


@pytest.mark.parametrize("number", [0, 1])
def test_writing_to_the_frames_of_the_training_scenes_is_refused(number: int) -> None:
    def scribble(oracle: PatchOracle, scenes: Any) -> None:
        scenes.pictures[number][0] = 1

    scenes = Pictured(torch.linspace(8, 30, 12))
    with pytest.raises(TamperError, match=r"the training scenes\.pictures\.\d changed") as refused:
        craft(Does(deed=scribble), RedDetector(), scenes, PatchThreat(), attack_seed=0, progress=lambda *said: None)
    assert refused.value.sides == ("attack",)


class Decoy(RedDetector):
    """Sees nothing when it thinks that an attack asks."""

    def suspects(self, pictures: Tensor) -> bool:
        return False

    def predict(self, pictures: Tensor) -> Predictions:
        return super().predict(torch.full_like(pictures, 0.5) if self.suspects(pictures) else pictures)


class WithGradients(Decoy):
    def suspects(self, pictures: Tensor) -> bool:
        return torch.is_grad_enabled()


class OfGraphs(Decoy):
    def suspects(self, pictures: Tensor) -> bool:
        return pictures.requires_grad


class OfSeveral(Decoy):
    def suspects(self, pictures: Tensor) -> bool:
        return 1 < len(pictures) < 10


class OfOddBatches(Decoy):
    def suspects(self, pictures: Tensor) -> bool:
        return len(pictures) % 2 == 1


class OfTheSameSeed(WithGradients):
    """It takes what asks with random numbers of another seed than its first image for a probe."""

    seed: int | None = None

    def suspects(self, pictures: Tensor) -> bool:
        self.seed = self.seed or torch.initial_seed()
        return super().suspects(pictures) and torch.initial_seed() == self.seed


@pytest.mark.parametrize("decoy", [WithGradients, OfGraphs, OfSeveral, OfOddBatches, OfTheSameSeed])
def test_a_detector_that_answers_attacks_otherwise_is_flagged(decoy: type[RedDetector]) -> None:
    flagged = [inconsistent(decoy(), entropy) for entropy in range(12)]
    assert np.mean(flagged) > 0.5


def test_an_honest_detector_is_not() -> None:
    assert not any(inconsistent(RedDetector(), entropy) for entropy in range(12))


def inconsistent(detector: RedDetector, entropy: int) -> float | int:
    scenes = RedScenes(torch.linspace(30, 8, 10))
    with torch.no_grad():
        seen = look(detector, scenes, None, 0.5)
    return probed(detector, [Approach(0, "front", scenes)], [seen], None, 0.5, entropy)["inconsistent"]


def test_a_detector_that_writes_to_what_it_aggregates_changes_no_measurement() -> None:
    class Inflates(RedDetector):
        def aggregate(self, scores: Tensor) -> Tensor:
            return scores.fill_(1.0)

    scenes, detector = RedScenes(torch.linspace(30, 8, 10)), Inflates()
    with torch.no_grad():
        seen = look(detector, scenes, None, 0.5)
        before = seen.by_frame.copy()
        probed(detector, [Approach(0, "front", scenes)], [seen], None, 0.5, 0)
    assert np.array_equal(seen.by_frame, before)
