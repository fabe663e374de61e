"""A gradient with a NaN costs the attack that entry and is counted; the rest of the row, and the attack, go on."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cavbench.attacks.driving.pgd import PGD
from cavbench.driving import ActionType, ObservationThreat, Policy, PolicyWrapper, State
from cavbench.driving.access import Enforcer, Oracle
from cavbench.driving.victim import CountedPolicy
from tests.attacks.driving.victims import FEATURES, observations, perturb, victim

EGO_VY = (slice(None), 0, 4)
"""The entry of the ego's lateral speed: 0 on a straight road."""


class Rooted(PolicyWrapper):
    """The scores of the policy, to which distances were added with the weight 0: the slope of a root at 0 is infinite.

    It is finite forward, as policies with a distance, a heading or a time to collision are.
    """

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        distance = (observation[..., 1].square() + observation[..., 2].square()).sqrt().sum(-1)
        heading = observation[..., 0, 4].abs().sqrt()
        return super().scores(observation, state) + 0.0 * (distance + heading).unsqueeze(-1)

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        return super().value(observation, action, state) + 0.0 * action[..., 1].abs().sqrt()


def straight(count: int) -> Tensor:
    """Observations with absent rows; half of the episodes drive straight on."""
    observation = observations(count)
    observation[: count // 2, 0, 4] = 0.0
    return observation


def begun(policy: Policy, observation: Tensor) -> tuple[Enforcer, Oracle]:
    enforcer = Enforcer(
        CountedPolicy(policy), ObservationThreat(budget=0.2), "gradients", FEATURES, torch.Generator().manual_seed(0)
    )
    return enforcer, enforcer.begin(observation)


@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
def test_a_nan_in_a_gradient_costs_only_its_entry(action_type: ActionType) -> None:
    observation = straight(8)
    found = []
    for policy in (victim(action_type), Rooted(victim(action_type))):
        enforcer, oracle = begun(policy, observation)
        found.append(oracle.gradient(observation, lambda scores: scores[..., 0])[1])
    honest, mended = found
    lost = torch.zeros_like(observation, dtype=torch.bool)
    lost[EGO_VY] = observation[EGO_VY] == 0
    lost[..., 1:3] |= observation[..., :1] == 0
    assert (lost[..., 1:3].any(), lost[EGO_VY].sum()) == (True, 4)
    assert torch.equal(mended, honest.masked_fill(lost, 0.0))
    # Absent rows cannot be changed: a NaN there costs the attack nothing.
    assert enforcer.counts[3].tolist() == [1] * 4 + [0] * 4


def test_a_critic_with_a_nan_in_its_gradient_still_says_the_rest() -> None:
    observation, action = straight(4), torch.tensor([[0.5, 0.0]]).expand(4, 2)
    found = []
    for policy in (victim("continuous"), Rooted(victim("continuous"))):
        enforcer, oracle = begun(policy, observation)
        leaf = action.clone().requires_grad_(True)
        with torch.enable_grad():
            oracle.value(observation, leaf).sum().backward()
        assert leaf.grad is not None
        found.append(leaf.grad)
    honest, mended = found
    assert bool(honest.all())
    assert torch.equal(mended, honest * torch.tensor([1.0, 0.0]))
    assert enforcer.counts[3].tolist() == [1] * 4


@pytest.mark.parametrize("momentum", [0.0, 0.9])
def test_pgd_is_as_strong_on_a_policy_whose_gradient_is_nan_for_absent_cars(momentum: float) -> None:
    observation, attack = observations(8), PGD(momentum=momentum)
    honest, mended = (
        perturb(attack, policy, observation)[0] for policy in (victim("discrete"), Rooted(victim("discrete")))
    )
    assert not torch.equal(honest, observation)
    assert torch.equal(honest, mended)
