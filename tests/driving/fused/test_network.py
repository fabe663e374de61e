"""Fused networks: torch's answers and gradients, the same in every batch, and torch wherever more is wanted than these."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import pytest
import torch
from torch import Tensor, nn

from cavbench.driving import Policy
from cavbench.driving.fused.network import _VIEWS, Fused, chain
from cavbench.driving.victims.from_file import FilePolicy
from cavbench.driving.victims.logits import SoftPolicy
from cavbench.driving.victims.networks import ActorPolicy, QPolicy
from cavbench.isolation.watch import marks
from tests.driving.victims.test_networks import observation


def tanh_file() -> Policy:
    network = nn.Sequential(
        nn.Flatten(), nn.Linear(50, 33), nn.Tanh(), nn.Sequential(nn.Linear(33, 7), nn.ReLU()), nn.Linear(7, 5)
    )
    return FilePolicy(network, (10, 5), "discrete", 5, "")


POLICIES: dict[str, Callable[[], Policy]] = {
    "dqn": lambda: QPolicy(5, 5, 64),
    "odd sizes": lambda: QPolicy(5, 3, 13),
    "ddpg": lambda: ActorPolicy(5, 64, 0.2),
    "sac": lambda: SoftPolicy(5, 5, 16, critics=2),
    "file": tanh_file,
}


@pytest.fixture(params=POLICIES)
def policy(request: pytest.FixtureRequest) -> Policy:
    torch.manual_seed(1)
    return POLICIES[request.param]().requires_grad_(False).eval()


def by_torch(work: Callable[[], Tensor]) -> Tensor:
    with patch.object(Fused, "fits", lambda self, observation: False):
        return work()


def used(work: Callable[[], Tensor]) -> tuple[Tensor, int]:
    """What comes out, and how many compiled passes it took."""
    with patch.object(Fused, "forward", autospec=True, side_effect=Fused.forward) as passes:
        return work(), passes.call_count


def slope(policy: Policy, x: Tensor) -> Tensor:
    """A gradient in the observation, with different weights of the scores and points."""
    asked = x.clone().requires_grad_()
    scores = policy.scores(asked)
    (found,) = torch.autograd.grad((scores * torch.arange(scores.numel()).view_as(scores).cos()).sum(), asked)
    return found


@pytest.mark.parametrize("points", [1, 15, 64, 65, 333])
def test_answers_and_gradients_are_those_of_torch(policy: Policy, points: int) -> None:
    x = observation((points,), seed=points)
    scores, passes = used(lambda: policy.scores(x))
    assert passes == 1
    torch.testing.assert_close(scores, by_torch(lambda: policy.scores(x)), atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(slope(policy, x), by_torch(lambda: slope(policy, x)), atol=3e-5, rtol=1e-5)


def test_a_row_has_the_same_bits_in_every_batch_and_place(policy: Policy) -> None:
    x = observation((150,))
    scores = policy.scores(x)
    for size in (*range(1, 70), 128, 129):
        assert torch.equal(policy.scores(x[-size:]), scores[-size:]), size
    asked = x.clone().requires_grad_()
    (whole,) = torch.autograd.grad(policy.scores(asked).sum(), asked)
    for size in (1, 7, 16, 17, 63, 64, 65, 100):
        part = x[-size:].clone().requires_grad_()
        (found,) = torch.autograd.grad(policy.scores(part).sum(), part)
        assert torch.equal(found, whole[-size:]), size
    # With a gradient the forward pass is the same.
    assert torch.equal(policy.scores(asked).detach(), scores)


def test_any_leading_shape_and_layout_gives_the_same_answers(policy: Policy) -> None:
    x = observation((6, 4))
    flat = policy.scores(x.flatten(0, 1))
    assert torch.equal(policy.scores(x).flatten(0, 1), flat)
    assert torch.equal(policy.scores(x.transpose(0, 1)).transpose(0, 1).flatten(0, 1), flat)
    assert policy.scores(x[:0]).shape == (0, 4, flat.shape[-1])


def test_a_nan_or_infinity_is_not_lost(policy: Policy) -> None:
    x = observation((3,))
    x[1, 0, 1] = torch.nan
    scores = policy.scores(x)
    assert bool(scores[1].isnan().any())
    assert bool(scores[[0, 2]].isfinite().all())


def test_a_network_with_an_infinite_weight_answers_as_torch_does(policy: Policy) -> None:
    other, x = copy.deepcopy(policy), observation((20,))
    next(iter(other.parameters())).data.flatten()[0] = torch.inf
    whole = other.scores(x)
    torch.testing.assert_close(whole, by_torch(lambda: other.scores(x)), rtol=0, atol=0, equal_nan=True)


def test_a_changed_weight_counts_in_the_next_call(policy: Policy) -> None:
    x = observation((20,))
    before = policy.scores(x)
    weight = next(iter(policy.parameters()))
    # Through `data` no version counter sees it, and the second one replaces the memory.
    for change in (lambda: weight.data.mul_(1.5), lambda: setattr(weight, "data", weight.data * 0.5)):
        change()
        after = policy.scores(x)
        assert not torch.equal(after, before)
        torch.testing.assert_close(after, by_torch(lambda: policy.scores(x)), atol=1e-6, rtol=1e-6)
        before = after


def test_a_copy_has_weights_of_its_own(policy: Policy) -> None:
    x = observation((20,))
    before = policy.scores(x)
    other = copy.deepcopy(policy)
    with torch.no_grad():
        for weight in other.parameters():
            weight.mul_(1.5)
    assert not torch.equal(other.scores(x), before)
    assert torch.equal(policy.scores(x), before)


@pytest.mark.parametrize(
    "more",
    [
        lambda policy: policy.requires_grad_(True),
        lambda policy: [
            one.register_forward_pre_hook(lambda *_: None) for one in policy.modules() if isinstance(one, nn.Linear)
        ],
        lambda policy: policy.double(),
    ],
    ids=["gradients of the weights", "a hook", "another precision"],
)
def test_torch_answers_where_more_is_wanted(policy: Policy, more: Callable[[Policy], object]) -> None:
    x = observation((20,))
    more(policy)
    asked = x.double() if next(iter(policy.parameters())).dtype == torch.float64 else x
    assert used(lambda: policy.scores(asked))[1] == 0


def linears(network: nn.Module) -> list[tuple[nn.Module, str]]:
    """Each linear layer, as the module that has it, and its name there."""
    return [
        (parent, name)
        for parent in network.modules()
        for name, one in parent.named_children()
        if isinstance(one, nn.Linear) and one.bias is not None
    ]


def another_layer(network: nn.Module, place: int) -> None:
    parent, name = linears(network)[place]
    old = getattr(parent, name)
    setattr(parent, name, nn.Linear(old.in_features, old.out_features).requires_grad_(False))


def another_activation(network: nn.Module) -> None:
    for parent in network.modules():
        for name, one in parent.named_children():
            if isinstance(one, (nn.ReLU, nn.Tanh)):
                setattr(parent, name, nn.ELU())


def another_forward(network: nn.Module) -> None:
    forward = network.forward
    network.forward = lambda *given: 0.5 * forward(*given)  # type: ignore[method-assign]


def clipped_activations(network: nn.Module) -> None:
    """As some defences do."""
    for one in network.modules():
        if isinstance(one, (nn.ReLU, nn.Tanh)):
            one.register_forward_hook(lambda module, given, answer: answer.clamp(max=0.05))


class Halved(nn.Linear):
    def forward(self, given: Tensor) -> Tensor:
        return super().forward(given) / 2


def another_class(network: nn.Module) -> None:
    parent, name = linears(network)[-1]
    getattr(parent, name).__class__ = Halved


def without_bias(network: nn.Module) -> None:
    parent, name = linears(network)[-1]
    getattr(parent, name).bias = None


CHANGES: dict[str, Callable[[nn.Module], object]] = {
    "first layer": lambda network: another_layer(network, 0),
    "last layer": lambda network: another_layer(network, -1),
    "bias": without_bias,
    "activations": another_activation,
    "hooks of activations": clipped_activations,
    "forward": another_forward,
    "hook": lambda network: network.register_forward_hook(lambda module, given, answer: answer * 2),
    "class of a layer": another_class,
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_network_that_was_changed_answers_as_torch_does(policy: Any, change: Callable[[nn.Module], object]) -> None:
    """A defence may change the network of the victim that it has loaded."""
    x = observation((20,))
    before = policy.scores(x)
    change(policy.actor if isinstance(policy, ActorPolicy) else policy.network)
    found = policy.scores(x)
    torch.testing.assert_close(found, by_torch(lambda: policy.scores(x)))
    assert not torch.allclose(found, before)


def test_another_limit_of_an_actor_counts() -> None:
    policy = POLICIES["ddpg"]().requires_grad_(False).eval()
    assert isinstance(policy, ActorPolicy)
    x = observation((20,))
    before = policy.scores(x)
    policy.actor.limit = policy.actor.limit / 2
    torch.testing.assert_close(policy.scores(x), before / 2)


def test_the_watch_sees_that_its_layers_were_exchanged() -> None:
    policy = POLICIES["dqn"]().requires_grad_(False).eval()
    assert isinstance(policy, QPolicy)
    x, before = observation((20,)), marks(policy)
    scores = policy.scores(x)
    assert marks(policy) == before
    fused = policy.network.fused
    # A copy of the weights in the place of a view of them changes nothing: it is not the weights.
    _VIEWS[fused][0] = _VIEWS[fused][0] * 2
    assert torch.equal(policy.scores(x), scores)
    fused.modules = tuple(copy.deepcopy(fused.modules))
    assert marks(policy)["methods"] != before["methods"]


def test_a_training_has_the_numbers_of_torch() -> None:
    policy = POLICIES["dqn"]().requires_grad_(False).train()
    assert used(lambda: policy.scores(observation((20,))))[1] == 0


def test_a_hook_still_hears_every_evaluation() -> None:
    policy, heard = POLICIES["dqn"]().requires_grad_(False).eval(), []
    assert isinstance(policy, QPolicy)
    policy.network.head[0].register_forward_pre_hook(lambda *_: heard.append(1))
    policy.scores(observation((2,)))
    assert heard == [1]


@pytest.mark.parametrize(
    "network",
    [
        nn.Sequential(nn.Linear(4, 4), nn.Sigmoid()),
        nn.Sequential(nn.Linear(4, 4, bias=False)),
        nn.Sequential(nn.ReLU(), nn.Linear(4, 4)),
        nn.Sequential(nn.Linear(4, 4), nn.ReLU(), nn.Tanh()),
        nn.Sequential(nn.Linear(4, 4), nn.Flatten(), nn.Linear(4, 2)),
        nn.Sequential(),
        lambda x: x,
    ],
)
def test_other_networks_are_left_to_torch(network: object) -> None:
    assert chain(network) is None


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7])
def test_answers_that_do_not_matter_change_no_gradient(
    policy: Policy, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a defence that takes the least of many answers: few are differentiated, with the bits that all would have."""
    x = observation((200,))
    monkeypatch.setattr("cavbench.driving.fused.network.MANY", 150)
    weights = torch.rand(200, 1, generator=torch.Generator().manual_seed(2))
    weights = weights * (torch.arange(200) % 100 < 100 * share)[:, None]

    def both(rows: Tensor) -> Tensor:
        asked = x[rows].requires_grad_()
        return torch.autograd.grad((policy.scores(asked) * weights[rows]).sum(), asked)[0]

    sparse, matters = both(torch.arange(200)), (weights[:, 0] > 0).nonzero().squeeze(1)
    if share:
        assert len(matters) < 150
        assert torch.equal(sparse[matters], both(matters))
    assert not sparse[weights[:, 0] == 0].any()
    assert bool(sparse.any()) == (share > 0)
