"""FCOS: which cells learn an object, and what its loss wants."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from cavbench.detection.victims import fcos
from cavbench.detection.victims.fcos import FCOSNetwork, Raw

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
