"""The networks: shapes, invariance to the order of cars, and gradients for attacks."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.driving import Policy
from cavbench.driving.victims.logits import SoftPolicy
from cavbench.driving.victims.networks import ActorPolicy, QPolicy, compiled


def observation(batch: tuple[int, ...], seed: int = 0) -> Tensor:
    """[..., 10, 5] with some cars absent."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.rand(*batch, 10, 5, generator=generator) * 2 - 1
    present = torch.rand(*batch, 10, 1, generator=generator) > 0.3
    present[..., 0, :] = True
    rows[..., :1] = 1.0
    return rows * present


@pytest.fixture(params=["dqn", "ddpg", "sac"])
def policy(request: pytest.FixtureRequest) -> Policy:
    torch.manual_seed(0)
    if request.param == "sac":
        return SoftPolicy(5, 5, 16)
    return QPolicy(5, 5, 16) if request.param == "dqn" else ActorPolicy(5, 16, 0.1)


def test_any_leading_shape_gives_the_same_answers(policy: Policy) -> None:
    x = observation((3, 4))
    torch.testing.assert_close(policy.scores(x).flatten(0, 1), policy.scores(x.flatten(0, 1)))


@settings(max_examples=20, deadline=None)
@given(order=st.permutations(range(1, 10)), seed=st.integers(0, 1000))
def test_the_order_of_the_other_cars_does_not_matter(order: list[int], seed: int) -> None:
    torch.manual_seed(seed)
    policy, x = QPolicy(5, 5, 16), observation((8,), seed)
    torch.testing.assert_close(policy.scores(x[:, [0, *order]]), policy.scores(x))


def test_the_row_of_an_absent_car_has_no_effect(policy: Policy) -> None:
    x = observation((8,))
    y = x.clone()
    y[..., 1:] += (x[..., :1] == 0) * torch.rand_like(x[..., 1:])
    torch.testing.assert_close(policy.scores(y), policy.scores(x))


def test_only_the_network_that_gives_a_policys_scores_stands_for_it(policy: Policy) -> None:
    x = observation((4,))
    network = compiled(policy.requires_grad_(False).eval(), x)
    if isinstance(policy, ActorPolicy):
        assert network is None
        return
    assert network is not None
    assert torch.equal(network(x), policy.scores(x))
    assert compiled(policy, x.double()) is None
    policy.register_forward_hook(lambda *_: None)
    assert compiled(policy, x) is None


def test_no_network_stands_for_a_policy_that_does_more() -> None:
    class Doubled(QPolicy):
        def forward(self, observation: Tensor) -> Tensor:
            return 2 * super().forward(observation)

    x = observation((4,))
    assert compiled(Doubled(5, 5, 16).requires_grad_(False).eval(), x) is None
    policy = QPolicy(5, 5, 16).requires_grad_(False).eval()
    policy.forward = lambda observation: observation.sum((-2, -1))  # type: ignore[method-assign]
    assert compiled(policy, x) is None
    assert compiled(QPolicy(5, 5, 16).requires_grad_(False).train(), x) is None
    assert compiled(QPolicy(5, 5, 16).eval(), x) is None


def test_the_actor_stays_within_its_steering_limit() -> None:
    torch.manual_seed(0)
    action = ActorPolicy(5, 16, 0.1).decide(observation((64,)) * 100)
    assert action[:, 0].abs().max() <= 1
    assert action[:, 1].abs().max() <= 0.1 + 1e-6


def test_scores_and_values_have_gradients_in_the_observation(policy: Policy) -> None:
    x = observation((4,)).requires_grad_(True)
    (gradient,) = torch.autograd.grad(policy.scores(x).sum(), x)
    assert gradient.abs().sum() > 0
    value = policy.value(x, policy.decide(x))
    assert value.shape == (4,)
    (gradient,) = torch.autograd.grad(value.sum(), x)
    assert gradient.abs().sum() > 0
