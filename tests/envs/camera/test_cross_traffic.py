"""Cross traffic follows from its seed."""

from __future__ import annotations

import torch

from cavbench.envs.camera.cross_traffic import LEAST_HEADWAY_S, CrossTraffic
from cavbench.envs.camera.street.layout import CROSSING


def test_cross_traffic_follows_from_its_seed_and_keeps_its_headway() -> None:
    first, again = (CrossTraffic.drawn([3, 4]) for _ in range(2))
    assert torch.equal(first.passes, again.passes)
    assert not torch.equal(first.passes[0], first.passes[1])
    by_lane = first.passes.view(2, 2, -1)
    assert float(by_lane.diff().min()) >= LEAST_HEADWAY_S - 1e-4
    rectangles = first.at(torch.tensor([7.0]))[0]
    assert (rectangles[..., 1] > CROSSING[0]).all()
    assert (rectangles[..., 3] < CROSSING[1]).all()
