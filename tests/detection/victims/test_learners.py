"""Detectors that learn with decoys: their networks, their training examples, the zoo, and the ones that ship."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cavbench import zoo
from cavbench.detection import STOP_SIGN, Detector
from cavbench.detection.approach import score
from cavbench.detection.victims import learner
from cavbench.detection.victims.detr import DETR
from cavbench.detection.victims.examples import Examples
from cavbench.detection.victims.fcos import FCOS
from cavbench.detection.victims.learner import Learner
from cavbench.detection.victims.rcnn import RCNN
from cavbench.detection.victims.windows import Windows
from cavbench.detection.victims.yolov5 import YOLOv5
from cavbench.envs.camera.axes import AXES
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError
from tests.detection.drawn_street import DrawnStreet

FACTS = StopSignApproach().facts
SIDE = 128
LEARNERS = [DETR, FCOS, RCNN, YOLOv5]

Kind = type[Learner[Detector]]


@pytest.fixture(scope="module", params=LEARNERS)
def network(request: pytest.FixtureRequest) -> Detector:
    torch.manual_seed(0)
    begun: Detector = request.param().begun(("stop sign", "car"))
    return begun.eval()


def test_the_images_of_a_batch_do_not_influence_each_other(network: Detector) -> None:
    pictures = torch.rand(2, 3, 64, 96, generator=torch.Generator().manual_seed(1))
    both, one = network(pictures), network(pictures[:1])
    # Predictions that are equally sure may change places.
    torch.testing.assert_close(both.scores[:1].sort(1).values, one.scores.sort(1).values, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(both.boxes[:1].sort(1).values, one.boxes.sort(1).values, rtol=1e-4, atol=1e-3)


def test_its_scores_have_gradients(network: Detector) -> None:
    pictures = torch.rand(1, 3, 64, 64, requires_grad=True)
    network(pictures).scores_of(0).sum().backward()
    assert pictures.grad is not None
    assert pictures.grad.abs().sum() > 0


def test_windows_with_a_decoy_have_no_sign() -> None:
    (approach,) = StopSignApproach().approaches(AXES.cell(lanes=3, density=1.0), range(1))
    scenes, generator = approach.scenes, torch.Generator().manual_seed(0)
    windows = Windows(scenes, SIDE, away=0.0, generator=generator)
    names = StopSignApproach.classes
    signs = {}
    for share in (0.0, 0.5, 1.0):
        examples = Examples(scenes, windows, names.index, decoys=share, generator=generator)
        drawn = examples.draw(40)
        assert all(len(box) == len(label) for box, label in zip(drawn.boxes, drawn.labels, strict=True))
        signs[share] = sum(int((label == names.index(STOP_SIGN)).sum()) for label in drawn.labels)
    assert signs[1.0] == 0 < signs[0.5] < signs[0.0]


@pytest.mark.parametrize("kind", LEARNERS)
def test_a_trained_detector_is_found_in_the_zoo(kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    victim = kind(updates=21, batch=2, window=64, trained_in="DrawnStreet")
    made = victim.train(DrawnStreet(), seed=4, progress=lambda share, text: None)
    assert made.network.names == (STOP_SIGN,)
    zoo.save(made.network, zoo.Recipe.of(victim), seed=4, world=DrawnStreet(), card=made.card)
    loaded = replace(victim, trained=4).load(0, FACTS)
    pictures = torch.rand(1, 3, 64, 64)
    for kernel in made.network.parameters():
        if kernel.ndim > 1:
            kernel.data = kernel.half().float()
    torch.testing.assert_close(loaded(pictures).scores, made.network(pictures).scores, rtol=1e-2, atol=1e-3)
    with pytest.raises(UserError, match="training seed 5"):
        replace(victim, trained=5).load(0, FACTS)


@pytest.mark.parametrize("kind", LEARNERS)
def test_a_training_that_was_stopped_ends_as_one_that_was_not(
    kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    monkeypatch.setattr(learner, "KEPT_EVERY", 4)
    victim = kind(updates=12, batch=2, window=64, trained_in="DrawnStreet")

    def stop(share: float, text: str) -> None:
        if share > 0.5:
            raise KeyboardInterrupt

    whole = victim.train(DrawnStreet(), seed=4, progress=lambda share, text: None)
    with pytest.raises(KeyboardInterrupt):
        victim.train(DrawnStreet(), seed=4, progress=stop)
    begun: list[float] = []
    made = victim.train(DrawnStreet(), seed=4, progress=lambda share, text: begun.append(share))
    assert begun[0] > 0.3, "it began again"
    for name, weight in whole.network.state_dict().items():
        assert torch.equal(weight, made.network.state_dict()[name]), name
    assert not list(tmp_path.rglob("*.unfinished"))


@pytest.mark.parametrize("kind", LEARNERS)
@pytest.mark.parametrize(
    "bad", [{"updates": 0}, {"window": 100}, {"decoys": 1.5}, {"away": -0.1}, {"trained": -1}], ids=str
)
def test_a_recipe_out_of_range_is_named(kind: Kind, bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        kind(**bad)


@pytest.mark.slow
@pytest.mark.parametrize("kind", LEARNERS)
def test_the_shipped_detector_knows_the_stop_sign(kind: Kind) -> None:
    world = StopSignApproach()
    measured = score(
        kind().load(0, FACTS), world.approaches(AXES.cell(lanes=3, density=1.0), range(3)), None, share=0.5
    )
    assert measured["average_precision"].mean() > 0.85
    assert measured["stop_score"].mean() > 0.4
