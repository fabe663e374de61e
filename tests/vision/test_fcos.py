"""FCOS: which cells learn an object, what its loss wants, its training, and the detector that ships."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from bench.detection import STOP_SIGN
from bench.detection.approach import score
from bench.errors import UserError
from bench.victims import zoo
from bench.victims.detectors import fcos
from bench.victims.detectors.examples import Examples
from bench.victims.detectors.fcos import FCOS, FCOSNetwork, Raw
from bench.victims.detectors.windows import Windows
from envs.camera.axes import AXES
from envs.camera.world import StopSignApproach
from tests.vision.drawn_street import DrawnStreet

FACTS = StopSignApproach().facts
SIDE = 128


@pytest.fixture(scope="module")
def network() -> FCOSNetwork:
    torch.manual_seed(0)
    return FCOSNetwork(("stop sign", "car")).eval()


def outputs(network: FCOSNetwork) -> Raw:
    with torch.no_grad():
        return network.raw(torch.zeros(1, 3, SIDE, SIDE))


def perfect(raw: Raw, boxes: Tensor, labels: Tensor) -> Raw:
    """The outputs of a network that knows the objects."""
    mine, owner, distances = fcos._assigned(raw, boxes)
    classes, centreness = torch.full_like(raw.classes, -12.0), torch.zeros_like(raw.centreness)
    classes[0, mine, labels[owner]] = 12.0
    known = raw.distances.clone()
    known[0, mine] = distances
    return replace(raw, classes=classes, distances=known, centreness=centreness)


def test_an_object_is_learnt_by_cells_near_its_centre_on_the_level_of_its_size(network: FCOSNetwork) -> None:
    raw = outputs(network)
    boxes = torch.tensor([[30.0, 30, 60, 64], [10, 2, 120, 124]])
    mine, owner, distances = fcos._assigned(raw, boxes)
    cells, strides = raw.cells[mine], raw.strides[mine]
    assert set(strides[owner == 0].tolist()) == {8.0}
    assert set(strides[owner == 1].tolist()) == {16.0, 32.0}
    middle = (boxes[owner, :2] + boxes[owner, 2:]) / 2
    assert ((cells - middle).abs().amax(1) < fcos.RADIUS * strides).all()
    torch.testing.assert_close(torch.cat((cells - distances[:, :2], cells + distances[:, 2:]), 1), boxes[owner])


def test_a_cell_in_two_objects_learns_the_smaller_one(network: FCOSNetwork) -> None:
    raw = outputs(network)
    small, large = torch.tensor([40.0, 40, 64, 64]), torch.tensor([20.0, 20, 84, 84])
    mine, owner, _ = fcos._assigned(raw, torch.stack((large, small)))
    here = raw.cells[mine][owner == 1]
    alone, _, _ = fcos._assigned(raw, small[None])
    assert len(here)
    assert torch.equal(here, raw.cells[alone])


def test_the_loss_is_lowest_where_the_objects_are_known(network: FCOSNetwork) -> None:
    raw = outputs(network)
    boxes, labels = torch.tensor([[30.0, 30, 60, 64], [70, 20, 100, 60]]), torch.tensor([0, 1])
    known = perfect(raw, boxes, labels)
    best = fcos.loss(known, [boxes], [labels])
    for worse in (
        replace(known, classes=-known.classes),
        replace(known, classes=known.classes.flip(-1)),
        replace(known, distances=known.distances * 1.5),
        replace(known, centreness=known.centreness - 9.0),
    ):
        assert fcos.loss(worse, [boxes], [labels]) > best + 0.05
    # Only the entropy of the centre-ness is left.
    assert best < 1.0


def test_images_without_objects_teach_that_there_is_nothing(network: FCOSNetwork) -> None:
    raw = outputs(network)
    nothing = [torch.zeros(0, 4)], [torch.zeros(0, dtype=torch.int64)]
    silent = replace(raw, classes=torch.full_like(raw.classes, -12.0))
    assert 0 <= fcos.loss(silent, *nothing) < 1e-3 < fcos.loss(replace(raw, classes=raw.classes + 5), *nothing)


def test_the_images_of_a_batch_do_not_influence_each_other(network: FCOSNetwork) -> None:
    pictures = torch.rand(2, 3, 64, 96, generator=torch.Generator().manual_seed(1))
    both, one = network(pictures), network(pictures[:1])
    torch.testing.assert_close(both.scores[:1], one.scores, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(both.boxes[:1], one.boxes, rtol=1e-4, atol=1e-3)


def test_its_scores_have_gradients(network: FCOSNetwork) -> None:
    pictures = torch.rand(1, 3, 64, 64, requires_grad=True)
    network(pictures).scores_of(0).sum().backward()
    assert pictures.grad is not None
    assert pictures.grad.abs().sum() > 0


def test_windows_with_a_decoy_have_no_sign() -> None:
    scenes = StopSignApproach().training_scenes()
    generator = torch.Generator().manual_seed(0)
    windows = Windows(scenes, SIDE, away=0.0, generator=generator)
    names = StopSignApproach.classes
    signs = {}
    for share in (0.0, 0.5, 1.0):
        examples = Examples(scenes, windows, names.index, decoys=share, generator=generator)
        drawn = examples.draw(40)
        assert all(len(box) == len(label) for box, label in zip(drawn.boxes, drawn.labels, strict=True))
        signs[share] = sum(int((label == names.index(STOP_SIGN)).sum()) for label in drawn.labels)
    assert signs[1.0] == 0 < signs[0.5] < signs[0.0]


def test_a_trained_detector_is_found_in_the_zoo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    victim = FCOS(updates=21, batch=2, window=64, trained_in="DrawnStreet")
    made = victim.train(DrawnStreet(), seed=4, progress=lambda share, text: None)
    assert made.network.names == (STOP_SIGN,)
    zoo.save(made.network, zoo.Recipe.of(victim), seed=4, world=DrawnStreet(), card=made.card)
    loaded = replace(victim, trained=4).load(0, FACTS)
    pictures = torch.rand(1, 3, 64, 64)
    torch.testing.assert_close(loaded(pictures).scores, made.network(pictures).scores, rtol=2e-2, atol=1e-3)
    with pytest.raises(UserError, match="training seed 5"):
        replace(victim, trained=5).load(0, FACTS)


@pytest.mark.parametrize("bad", [{"updates": 0}, {"window": 100}, {"decoys": 1.5}, {"trained": -1}])
def test_a_recipe_out_of_range_is_named(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        FCOS(**bad)


@pytest.mark.slow
def test_the_shipped_detector_knows_the_stop_sign() -> None:
    world = StopSignApproach()
    measured = score(
        FCOS().load(0, FACTS), world.approaches(AXES.cell(lanes=3, density=1.0), range(3)), None, share=0.5
    )
    assert measured["average_precision"].mean() > 0.85
    assert measured["stop_score"].mean() > 0.4
