"""Targets: every one is reached by its own action."""

from __future__ import annotations

import pytest
import torch

from cavbench.attacks.driving.objectives import margin
from cavbench.attacks.driving.targets import Controls, EveryAction


def test_every_target_is_reached_by_its_own_action() -> None:
    controls, numbers = Controls(0.1), torch.arange(9)
    actions = controls.action(numbers)
    assert actions.abs().amax(0).tolist() == pytest.approx([1.0, 0.1])
    assert torch.equal(controls.loss(actions, numbers), torch.zeros(9))
    scores = torch.eye(5)
    assert bool((controls.loss(actions, numbers.roll(1)) > 0.9).all())
    assert bool((margin(scores, torch.arange(5)) == -EveryAction(5).loss(scores, torch.arange(5))).all())
