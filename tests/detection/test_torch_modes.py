"""Modes of torch that a patch attack or a detector leaves on: noticed, or put back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.detection import PatchOracle, Predictions
from cavbench.detection.approach import probed
from cavbench.detection.crafting import craft
from cavbench.detection.scenes import Approach
from cavbench.detection.sight import look
from cavbench.detection.threat import PatchThreat
from cavbench.isolation.modes import numbers
from cavbench.isolation.watch import TamperError
from tests.detection.test_bending_patches import Does
from tests.isolation.torch_modes import NUMBERS, STACKED, Left, leaving
from tests.plugins.toy_camera import RedDetector, RedScenes

SCENES = RedScenes(torch.linspace(8, 30, 6))


class Asks(Does):
    """Does the same with access to scores."""

    access: ClassVar[Access] = "scores"


def crafted(deed: Callable[[PatchOracle, Any], object], detector: RedDetector | None = None) -> None:
    craft(Asks(deed=deed), detector or RedDetector(), SCENES, PatchThreat(), attack_seed=0, progress=lambda *said: None)


def ask(oracle: PatchOracle, scenes: Any) -> Predictions:
    return oracle.predict(scenes.render(torch.tensor([0]), None, 0.5))


@pytest.mark.parametrize("name", STACKED)
def test_a_mode_that_an_attack_leaves_on_is_noticed(name: str) -> None:
    with Left(name) as mode, pytest.raises(TamperError, match=f"the attack left {name}"):
        crafted(lambda oracle, scenes: mode.enter())


@pytest.mark.parametrize("name", sorted(STACKED.keys() - {"inference mode"}))
def test_a_detector_is_not_asked_under_a_mode_of_the_attack(name: str) -> None:
    def under(oracle: PatchOracle, scenes: Any) -> None:
        mode.enter()
        ask(oracle, scenes)

    with Left(name) as mode, pytest.raises(TamperError, match=f"the attack asked under {name}"):
        crafted(under)


@pytest.mark.parametrize("name", STACKED)
@pytest.mark.parametrize("where", ["predict", "advance", "aggregate"])
def test_a_mode_that_a_detector_leaves_on_is_noticed(name: str, where: str) -> None:
    with Left(name) as mode:
        detector, said = leaving(RedDetector, where, mode)(), f"the defense left {name}"
        with pytest.raises(TamperError, match=said), torch.no_grad():
            probed(detector, [Approach(0, "front", SCENES)], [look(detector, SCENES, None, 0.5)], None, 0.5, 0)
    if where == "advance":
        return
    with Left(name) as mode:
        detector = leaving(RedDetector, where, mode)()
        with pytest.raises(TamperError, match=said):
            crafted(lambda oracle, scenes: (ask(oracle, scenes), oracle.aggregate(torch.rand(4))), detector)


@pytest.mark.parametrize("change", NUMBERS.values(), ids=NUMBERS)
def test_what_one_side_sets_changes_no_numbers_of_the_other(change: Callable[[], object]) -> None:
    usual, of_detector, of_attack = numbers(), set(), set()

    class Sets(RedDetector):
        def predict(self, pictures: Tensor) -> Predictions:
            of_detector.add(numbers())
            change()
            return super().predict(pictures)

    def deed(oracle: PatchOracle, scenes: Any) -> None:
        of_attack.add(numbers())
        ask(oracle, scenes)
        of_attack.add(numbers())
        change()
        ask(oracle, scenes)

    crafted(deed, Sets())
    assert of_detector == of_attack == {numbers()} == {usual}
