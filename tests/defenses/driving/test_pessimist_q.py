"""The belief holds the truth, and the action whose lowest value is highest is taken."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cavbench.core.options import configured, parameter_words
from cavbench.defenses.driving.pessimist_q import Believing, PessimistQ
from cavbench.driving import Policy
from cavbench.driving.intervals.boxes import Assumed
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from tests.attacks.driving.victims import observations, victim
from tests.driving.policies import Given, remembered

FACTS = HighwayWorld().facts
FAST, SLOW = FACTS.actions.index("FASTER"), FACTS.actions.index("SLOWER")


class Gap(Policy):
    """FASTER is worth the distance to the first other car, SLOWER a given distance."""

    action_type = "discrete"

    def __init__(self, enough: float) -> None:
        super().__init__()
        self.enough = enough

    def forward(self, observation: Tensor) -> Tensor:
        scores = torch.full((*observation.shape[:-2], len(FACTS.actions)), -1.0)
        scores[..., FAST], scores[..., SLOW] = observation[..., 1, 1], self.enough
        return scores


def believing(policy: Policy, **settings: float) -> Believing:
    made = PessimistQ(**settings).load(Given(policy=policy), 0, FACTS)  # type: ignore[arg-type]
    assert isinstance(made, Believing)
    return made


def test_the_belief_is_within_the_boxes_and_keeps_empty_rows() -> None:
    policy, shown = believing(victim("discrete")), observations(6, 0)
    boxes = Assumed(FACTS.features, "relative", 0.1).boxes(shown)
    points = policy.belief(shown, boxes)
    low, high = policy.assumed.normalised(boxes.low), policy.assumed.normalised(boxes.high)
    present = boxes.present.unsqueeze(-1)
    assert len(points) == 3 + policy.settings.corners
    assert ((points[..., 1:] >= low - 1e-6) & (points[..., 1:] <= high + 1e-6) | ~present).all()
    assert (points == shown)[..., ~boxes.present, :].all()


@pytest.mark.parametrize(("pessimism", "action"), [(0.0, FAST), (1.0, SLOW)])
def test_an_action_that_is_good_only_at_the_middle_is_not_taken(pessimism: float, action: int) -> None:
    shown = torch.zeros(1, 10, 5)
    shown[0, :2, 0], shown[0, 1, 1] = 1, 0.5
    # The car may be at 0.5 / 1.1 = 0.4545.
    policy = believing(Gap(enough=0.48), pessimism=pessimism)
    state = policy.initial(torch.tensor([1]))
    assert policy.decide(shown, state).tolist() == [action]


def test_scores_of_a_batch_are_those_of_its_episodes() -> None:
    policy, shown = believing(victim("discrete")), observations(4, 1)
    state = remembered(policy, 4, 3)
    together = policy.scores(shown, state)
    for row in range(4):
        torch.testing.assert_close(policy.scores(shown[row : row + 1], state[row : row + 1])[0], together[row])


def test_the_gradient_of_the_lowest_values_reaches_the_observation() -> None:
    policy, shown = believing(victim("discrete")), observations(4, 2).requires_grad_()
    (gradient,) = torch.autograd.grad(policy.scores(shown, remembered(policy, 4, 2)).sum(), shown)
    assert (gradient[:, 1:, 1:].abs().sum((-1, -2)) > 0).all()


def test_a_victim_with_continuous_actions_is_refused() -> None:
    with pytest.raises(UserError, match="whose actions are discrete"):
        PessimistQ().load(Given(policy=victim("continuous")), 0, FACTS)


def test_a_tracker_in_front_narrows_the_belief() -> None:
    chain = configured("defense", "tracker+pessimist_q", parameter_words("tracker.assumed_noise=0")).component.load(
        Given(policy=victim("discrete")), 0, FACTS
    )
    alone = believing(victim("discrete"))
    shown = observations(4, 3)
    state = chain.advance(shown, torch.full((4,), SLOW), chain.initial(torch.arange(4)))
    boxes, own = chain.boxes(shown, state), alone.assumed.boxes(shown)
    assert ((boxes.high - boxes.low) <= (own.high - own.low) + 1e-6).all()
    assert chain.assured(shown, state) is None
    assert chain.scores(shown, state).shape == (4, len(FACTS.actions))
