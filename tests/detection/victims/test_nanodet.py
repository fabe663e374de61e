"""NanoDet from its published graph: boxes where the sign is, at any size, with a gradient."""

from __future__ import annotations

import pytest
import torch

from cavbench.detection.boxes import confidence, detections
from cavbench.detection.victims.nanodet import BINS, NanoDet, NanoDetNetwork, _decoded
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError
from cavbench.formats import tfjs_file
from cavbench.formats.tfjs_graph import Graph
from cavbench.zoo import fetch
from tests.detection.pictures import stop_sign


@pytest.fixture(scope="session")
def nanodet() -> NanoDetNetwork:
    """With its published weights, which are fetched if need be; without a network the test is skipped."""
    try:
        return NanoDet().load(0, StopSignApproach().facts)
    except UserError as error:
        pytest.skip(str(error))


def test_a_distance_is_the_mean_of_its_distribution() -> None:
    """All mass on bins 1, 2, 3 and 4: the sides are 1, 2, 3 and 4 cells from the cell's centre."""
    sides = torch.full((1, 4 * BINS, 2, 3), -100.0)
    for side in range(4):
        sides[:, side * BINS + side + 1] = 100.0
    boxes, scores = _decoded(torch.rand(1, 80, 2, 3), sides, 8)
    assert scores.shape == (1, 6, 80)
    # The last cell: its centre is at (20, 12).
    torch.testing.assert_close(boxes[0, -1], torch.tensor([20.0 - 8, 12 - 16, 20 + 24, 12 + 32]))


@pytest.mark.slow
def test_the_graph_is_read_for_any_size_as_for_its_own(nanodet: NanoDetNetwork) -> None:
    file = tfjs_file.read(fetch.weights("nanodet"), "nanodet")
    pictures = torch.rand(1, 3, 416, 416, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        own = nanodet.predict(pictures).classes
        outputs = Graph(file)((pictures.flip(1) - nanodet.mean) / nanodet.deviation)
        scores = {one.shape[1]: one for one in outputs if one.shape[2] == 80}
        wanted = torch.cat([scores[count] for count in sorted(scores, reverse=True)], 1)
        torch.testing.assert_close(own, wanted)
        assert nanodet(torch.rand(2, 3, 96, 160)).boxes.shape == (2, 12 * 20 + 6 * 10 + 3 * 5, 4)


@pytest.mark.slow
def test_a_stop_sign_is_found_where_it_is_and_a_step_against_the_gradient_hides_it_a_little(
    nanodet: NanoDetNetwork,
) -> None:
    picture, box = stop_sign(100)
    label = nanodet.index("stop sign")
    with torch.no_grad():
        (found,) = detections(nanodet(picture[None]), threshold=0.5, iou=0.5)
        sure = confidence(nanodet(picture[None]), label, box[None], iou=0.7)
    assert found.labels.tolist() == [label]
    assert float(sure) > 0.7
    leaf = picture[None].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(nanodet(leaf).scores_of(label).amax(), leaf)
    with torch.no_grad():
        less = confidence(nanodet((leaf - 0.02 * gradient.sign()).clamp(0, 1)), label, box[None], iou=0.3)
    assert float(less) < float(sure) - 0.05
