"""The fused network with a memory: torch's answers and gradients, the same in every batch, and torch wherever more is wanted."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cavbench.compiled import entry_point
from cavbench.defenses.driving.recurrent import RecurrentNetwork
from cavbench.driving.fused import recurrent
from cavbench.driving.fused.kernels import Floats
from cavbench.driving.fused.recurrent import Recurrent
from cavbench.driving.victims.networks import whatever_the_batch
from cavbench.isolation.watch import marks
from tests.driving.fused.test_network import CHANGES
from tests.driving.victims.test_networks import observation

SIZES = {"shipped": (5, 64, 32), "odd": (3, 13, 7)}


@pytest.fixture(params=SIZES)
def network(request: pytest.FixtureRequest) -> RecurrentNetwork:
    """Its weights are large enough that the memory matters."""
    torch.manual_seed(1)
    actions, hidden, memory = SIZES[request.param]
    made = RecurrentNetwork(5, actions, hidden, memory).requires_grad_(False).eval()
    for weight in made.parameters():
        weight.mul_(2)
    return made


def memory(network: RecurrentNetwork, count: int) -> Tensor:
    return torch.rand(count, network.cell.hidden_size, generator=torch.Generator().manual_seed(count)) * 2 - 1


def by_torch(work: Callable[[], Tensor]) -> Tensor:
    with patch.object(Recurrent, "fits", lambda self, *given: False):
        return work()


def used(work: Callable[[], Tensor]) -> tuple[Tensor, int]:
    """What comes out, and how many compiled passes it took."""
    with patch.object(Recurrent, "forward", autospec=True, side_effect=Recurrent.forward) as passes:
        return work(), passes.call_count


def slope(network: RecurrentNetwork, x: Tensor, before: Tensor, only: slice = slice(None)) -> Tensor:
    """A gradient in the observation, with different weights of logits and memory."""
    asked = x.clone().requires_grad_()
    answer = whatever_the_batch(network, asked, before)[:, only]
    (found,) = torch.autograd.grad((answer * torch.arange(1, answer.shape[1] + 1).cos()).sum(), asked)
    return found


@pytest.mark.parametrize("points", [1, 15, 64, 65, 333])
def test_answers_and_gradients_are_those_of_torch(network: RecurrentNetwork, points: int) -> None:
    x, before = observation((points,), seed=points), memory(network, points)
    answer, passes = used(lambda: whatever_the_batch(network, x, before))
    assert passes == 1
    wanted = by_torch(lambda: whatever_the_batch(network, x, before))
    torch.testing.assert_close(answer, wanted, atol=1e-6, rtol=1e-6)
    actions = network.fused.outputs - network.fused.memory
    for only in (slice(None), slice(actions), slice(actions, None)):
        found = slope(network, x, before, only)
        assert bool(found.any())
        wanted = by_torch(lambda only=only: slope(network, x, before, only))  # type: ignore[misc]
        torch.testing.assert_close(found, wanted, atol=3e-5, rtol=1e-5)


def test_the_gates_are_those_of_numpy() -> None:
    @entry_point
    def gate(x: Floats, y: Floats) -> None:
        for i in range(len(x)):
            y[i] = recurrent.sigmoid(x[i])

    x = np.linspace(-30, 30, 100_001).astype(np.float32)
    x = np.concatenate((x, np.array([-np.inf, np.inf, np.nan], np.float32)))
    y = np.empty_like(x)
    gate(x, y)
    np.testing.assert_allclose(y, 1 / (1 + np.exp(-x.astype(np.float64))), rtol=0, atol=2e-7)
    assert y[-3:-1].tolist() == [0, 1]


def test_a_row_has_the_same_bits_in_every_batch_and_place(network: RecurrentNetwork) -> None:
    x, before = observation((150,)), memory(network, 150)
    whole, slopes = whatever_the_batch(network, x, before), slope(network, x, before)
    for size in (*range(1, 91), 128, 129):
        assert torch.equal(whatever_the_batch(network, x[-size:], before[-size:]), whole[-size:]), size
        assert torch.equal(slope(network, x[-size:], before[-size:]), slopes[-size:]), size
    # With a gradient the forward pass is the same.
    assert torch.equal(whatever_the_batch(network, x.clone().requires_grad_(), before).detach(), whole)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7])
def test_answers_that_do_not_matter_change_no_gradient(
    network: RecurrentNetwork, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, before = observation((200,)), memory(network, 200)
    monkeypatch.setattr("cavbench.driving.fused.network.MANY", 150)
    matter = torch.arange(200) % 100 < 100 * share

    def both(rows: Tensor) -> Tensor:
        asked = x[rows].requires_grad_()
        answer = whatever_the_batch(network, asked, before[rows])
        return torch.autograd.grad((answer * matter[rows, None]).sum(), asked)[0]

    sparse = both(torch.arange(200))
    assert torch.equal(sparse[matter], both(matter.nonzero().squeeze(1)))
    assert not sparse[~matter].any()
    assert bool(sparse.any()) == (share > 0)


def test_any_leading_shape_and_layout_gives_the_same_answers(network: RecurrentNetwork) -> None:
    x, before = observation((6, 4)), memory(network, 24).unflatten(0, (6, 4))
    flat = whatever_the_batch(network, x.flatten(0, 1), before.flatten(0, 1))
    assert torch.equal(whatever_the_batch(network, x, before).flatten(0, 1), flat)
    other = whatever_the_batch(network, x.transpose(0, 1), before.transpose(0, 1))
    assert torch.equal(other.transpose(0, 1).flatten(0, 1), flat)
    assert whatever_the_batch(network, x[:0], before[:0]).shape == (0, 4, flat.shape[-1])


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("where", ["observation", "memory"])
def test_a_nan_or_infinity_is_that_of_torch(network: RecurrentNetwork, value: float, where: str) -> None:
    x, before = observation((20,)), memory(network, 20)
    (x[1, 0] if where == "observation" else before[1])[1] = value
    found = whatever_the_batch(network, x, before)
    wanted = by_torch(lambda: whatever_the_batch(network, x, before))
    assert not wanted[1].isfinite().all() or where == "observation"
    torch.testing.assert_close(found, wanted, atol=1e-6, rtol=1e-6, equal_nan=True)
    assert bool(found[[0, *range(2, 20)]].isfinite().all())


def test_a_changed_weight_counts_in_the_next_call(network: RecurrentNetwork) -> None:
    x, before = observation((20,)), memory(network, 20)
    answer = whatever_the_batch(network, x, before)
    weight = network.cell.weight_hh
    # Through `data` no version counter sees it, and the second one replaces the memory.
    for change in (lambda: weight.data.mul_(1.5), lambda: setattr(weight, "data", weight.data * 0.5)):
        change()
        after, passes = used(lambda: whatever_the_batch(network, x, before))
        assert passes == 1
        assert not torch.equal(after, answer)
        wanted = by_torch(lambda: whatever_the_batch(network, x, before))
        torch.testing.assert_close(after, wanted, atol=1e-6, rtol=1e-6)
        answer = after


def without_bias(network: Any) -> None:
    network.cell.bias_ih = network.cell.bias_hh = None


def another_cell(network: Any) -> None:
    network.cell = nn.GRUCell(network.cell.input_size, network.cell.hidden_size).requires_grad_(False)


class Forgetful(nn.GRUCell):
    def forward(self, given: Tensor, before: Tensor | None = None) -> Tensor:
        return super().forward(given)


def another_class_of_cell(network: Any) -> None:
    network.cell.__class__ = Forgetful


MORE: dict[str, Callable[[nn.Module], object]] = {
    **CHANGES,
    "cell": another_cell,
    "cell without bias": without_bias,
    "class of the cell": another_class_of_cell,
    "hook of the cell": lambda network: network.cell.register_forward_hook(lambda *given: given[-1] / 2),
}


@pytest.mark.parametrize("change", MORE.values(), ids=MORE)
def test_a_network_that_was_changed_answers_as_torch_does(
    network: RecurrentNetwork, change: Callable[[nn.Module], object]
) -> None:
    x, before = observation((20,)), memory(network, 20)
    answer = whatever_the_batch(network, x, before)
    change(network)
    found, passes = used(lambda: whatever_the_batch(network, x, before))
    assert passes == 0
    torch.testing.assert_close(found, by_torch(lambda: whatever_the_batch(network, x, before)), rtol=0, atol=0)
    assert not torch.allclose(found, answer)


@pytest.mark.parametrize(
    "more",
    [
        lambda network, x, before: (network.requires_grad_(True), x, before),
        lambda network, x, before: (network.train(), x, before),
        lambda network, x, before: (network.double(), x.double(), before.double()),
        lambda network, x, before: (network, x, before.requires_grad_()),
    ],
    ids=["gradients of the weights", "training", "another precision", "gradient of the memory"],
)
def test_torch_answers_where_more_is_wanted(network: RecurrentNetwork, more: Callable[..., Any]) -> None:
    given = more(network, observation((20,)), memory(network, 20))
    assert used(lambda: whatever_the_batch(*given))[1] == 0


def test_a_copy_has_weights_of_its_own(network: RecurrentNetwork) -> None:
    x, before = observation((20,)), memory(network, 20)
    answer, other = whatever_the_batch(network, x, before), copy.deepcopy(network)
    for weight in other.parameters():
        weight.mul_(1.5)
    found, passes = used(lambda: whatever_the_batch(other, x, before))
    assert passes == 1
    assert not torch.equal(found, answer)
    assert torch.equal(whatever_the_batch(network, x, before), answer)


def test_the_watch_sees_that_its_layers_were_exchanged(network: RecurrentNetwork) -> None:
    seen = marks(network)
    whatever_the_batch(network, observation((20,)), memory(network, 20))
    assert marks(network) == seen
    network.fused.modules = copy.deepcopy(network.fused.modules)
    assert marks(network)["methods"] != seen["methods"]
