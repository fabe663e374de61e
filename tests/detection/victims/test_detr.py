"""The DETR: where its queries come from, what they see of each other and of the image, and that it finds an object once."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cavbench import zoo
from cavbench.detection.boxes import overlap
from cavbench.detection.victims import detr
from cavbench.detection.victims.detr import DETR, HIDDEN, MAPS, DETRNetwork, Look, Together
from cavbench.detection.victims.examples import Example
from cavbench.detection.victims.fcos import FCOS, FCOSNetwork
from cavbench.envs.camera.axes import AXES
from cavbench.envs.camera.world import StopSignApproach

NAMES = ("stop sign", "car")
SIDE = 160
BOXES = torch.tensor([[[20.0, 32, 76, 60], [90, 80, 104, 150], [92, 82, 106, 148]]])


@pytest.fixture(scope="module")
def network() -> DETRNetwork:
    torch.manual_seed(0)
    return DETR().begun(NAMES).eval()


@pytest.fixture
def queries() -> Tensor:
    return torch.randn(1, 3, HIDDEN, generator=torch.Generator().manual_seed(0))


def features(seed: int = 0) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(1, channels, SIDE // stride, SIDE // stride, generator=generator) for stride, channels in MAPS]


@torch.no_grad()
def test_the_queries_begin_at_the_surest_cells_of_the_encoder(network: DETRNetwork) -> None:
    pictures = torch.rand(2, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(1))
    raw, answers = network.answers(pictures)
    sure = raw.classes[..., 0].sigmoid() * raw.centreness.sigmoid()
    best = sure.topk(detr.QUERIES, 1).indices
    # Layers that have learnt nothing do not move boxes.
    for answer in answers:
        torch.testing.assert_close(answer.boxes, raw.boxes.gather(1, best.unsqueeze(-1).expand(-1, -1, 4)))


@torch.no_grad()
def test_queries_see_each_other_alike_wherever_they_are_and_however_large(queries: Tensor) -> None:
    torch.manual_seed(0)
    together = Together()
    here = together(queries, BOXES)
    torch.testing.assert_close(together(queries, BOXES * 3 + 500), here)
    apart = BOXES + torch.tensor([[0.0], [0], [40]])
    assert (together(queries, apart) - here).abs().max() > 1e-4


@torch.no_grad()
def test_a_query_that_has_learnt_nothing_looks_into_its_box_only(queries: Tensor) -> None:
    look = Look()
    here = look(queries, BOXES, features())
    mixed = []
    for (stride, _), one, other in zip(MAPS, features(), features(1), strict=True):
        at = (torch.arange(SIDE // stride) + 0.5) * stride
        # A sample at the edge of a box sees the cells on both sides.
        x1, y1, x2, y2 = BOXES[0, 0] + torch.tensor([-stride, -stride, stride, stride])
        inside = ((at > y1) & (at < y2))[:, None] & ((at > x1) & (at < x2))
        mixed.append(one.where(inside, other))
    seen = look(queries, BOXES, mixed)
    torch.testing.assert_close(seen[:, 0], here[:, 0])
    assert (seen[:, 1:] - here[:, 1:]).abs().amax() > 0.01


def test_the_encoder_begins_as_the_fcos_of_the_zoo_and_its_backbone_does_not_learn(network: DETRNetwork) -> None:
    known = zoo.load(zoo.Recipe.of(FCOS()), 0, FCOSNetwork).state_dict()
    own = network.first.state_dict()
    assert known.keys() == own.keys()
    assert {name for name in own if not torch.equal(own[name], known[name])} == {
        "score.weight",
        "score.bias",
    } & own.keys()
    torch.manual_seed(0)
    learner = DETR().begun(NAMES).train()
    boxes, labels = [torch.tensor([[40.0, 40, 90, 80]])], [torch.tensor([1])]
    detr.loss(learner, Example(torch.full((1, 3, SIDE, SIDE), 0.5), boxes, labels)).backward()
    still = {name.split(".")[1] for name, weight in learner.named_parameters() if weight.grad is None}
    assert still == {"stem", "stages"}


def test_all_layers_learn_from_an_image_without_objects(network: DETRNetwork) -> None:
    nothing = Example(torch.full((1, 3, SIDE, SIDE), 0.5), [torch.zeros(0, 4)], [torch.zeros(0, dtype=torch.int64)])
    lost = detr.loss(network, nothing)
    assert torch.isfinite(lost)
    grads = torch.autograd.grad(lost, [layer.name.bias for layer in network.layers])
    assert all((grad > 0).all() for grad in grads)


@pytest.mark.slow
@torch.no_grad()
def test_the_shipped_detector_finds_a_sign_seldom_twice_though_many_queries_begin_there() -> None:
    world = StopSignApproach()
    network = DETR().load(0, world.facts)
    label, begun, found = network.index("stop sign"), [], []
    for approach in world.approaches(AXES.cell(lanes=3, density=1.0), range(2)):
        scenes = approach.scenes
        raw, answers = network.answers(scenes.render(torch.arange(len(scenes)), None, 1.0))
        best = (raw.classes[..., 0].sigmoid() * raw.centreness.sigmoid()).topk(detr.QUERIES, 1).indices
        first = raw.boxes.gather(1, best.unsqueeze(-1).expand(-1, -1, 4))
        truth = scenes.boxes.unsqueeze(1)
        last = answers[-1]
        sure = last.logits[..., label].sigmoid() > 0.4
        begun += (overlap(first, truth) > 0.5).sum(1).tolist()
        found += ((overlap(last.boxes, truth) > 0.5) & sure).sum(1).tolist()
    assert sum(begun) > 4 * len(begun)
    assert len(found) * 0.8 < sum(found) < 2 * len(found)
    assert max(found) <= 4
