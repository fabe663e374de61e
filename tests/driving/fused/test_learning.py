"""Compiled training: torch's gradients, Adam and target network, and a DQN that learns what torch's learns."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor

from cavbench.driving import TrainingHooks
from cavbench.driving.fused.trainable import Trainable
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.networks import Actor, QNetwork
from cavbench.driving.victims.practice import ALLOWED, Practice
from tests.driving.fused.both import both, learner, only
from tests.driving.victims.test_networks import observation

NETWORKS = {
    "dqn": lambda: QNetwork(5, 5, 128),
    "odd sizes": lambda: QNetwork(5, 3, 13),
    "scaled": lambda: Actor(5, 64, torch.tensor([1.0, 0.2])),
}


@pytest.fixture(params=NETWORKS)
def network(request: pytest.FixtureRequest) -> Any:
    torch.manual_seed(1)
    return NETWORKS[request.param]()


def torchs(network: Any, x: Tensor, by_answers: Tensor) -> tuple[Tensor, Tensor]:
    """The answers, and the gradient in all parameters in the order of the compiled vector."""
    answers = network(x)
    parameters = [weight for weight in network.fused._weights() if weight.requires_grad]
    grads = torch.autograd.grad(answers, parameters, by_answers)
    return answers.detach(), torch.cat([grad.reshape(-1) for grad in grads])


@pytest.mark.parametrize("points", [1, 15, 64, 65, 200])
def test_the_gradient_in_the_weights_is_that_of_torch(network: Any, points: int) -> None:
    x = observation((points,), seed=points)
    answers, gradient = torchs(copy.deepcopy(network), x, by := torch.randn(points, network.fused.outputs))
    compiled = Trainable(network.fused)
    torch.testing.assert_close(compiled.forward(x), answers, atol=1e-6, rtol=1e-6)
    compiled.backward(by)
    found = torch.from_numpy(compiled.by_weights)
    torch.testing.assert_close(found[: len(gradient)], gradient, atol=3e-5, rtol=1e-5)
    assert not found[len(gradient) :].any()


def test_the_gradient_is_in_the_weights_of_the_answers(network: Any) -> None:
    x = observation((70,))
    by = torch.randn(70, network.fused.outputs)
    compiled = Trainable(network.fused)
    others = compiled.weights * 1.5
    compiled.forward(x, weights=others)
    compiled.backward(by)
    found = compiled.by_weights.copy()
    compiled.weights[:] = others
    compiled.forward(x)
    compiled.backward(by)
    assert (found == compiled.by_weights).all()


@pytest.mark.parametrize("longest", [1e9, 0.5])
def test_steps_are_those_of_torchs_adam_and_soft_update(longest: float) -> None:
    torch.manual_seed(0)
    network = QNetwork(5, 5, 16)
    other, mean = copy.deepcopy(network), copy.deepcopy(network)
    compiled, adam = Trainable(network.fused), torch.optim.Adam(other.parameters())
    average = compiled.weights.copy()
    for number in range(20):
        x, by = observation((40,), seed=number), torch.randn(40, 5)
        rate = 1e-3 / (1 + number)
        compiled.forward(x)
        compiled.backward(by)
        compiled.step(rate, longest=longest, average=average, tau=0.1)
        adam.param_groups[0]["lr"] = rate
        adam.zero_grad()
        other(x).backward(by)
        torch.nn.utils.clip_grad_norm_(other.parameters(), longest)
        adam.step()
        for slow, fast in zip(mean.parameters(), other.parameters(), strict=True):
            slow.data.lerp_(fast.data, 0.1)
    # The network goes on to use the weights of the compiled steps.
    for own, torchs_own in zip(network.parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(own, torchs_own, atol=2e-6, rtol=1e-5)
    network.fused.assign(torch.from_numpy(average))
    for own, torchs_own in zip(network.parameters(), mean.parameters(), strict=True):
        torch.testing.assert_close(own, torchs_own, atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize(("phase", "behind"), [(0, ""), (1, ""), (1, "shield")])
def test_a_dqn_learns_what_it_learns_with_torch(phase: int, behind: str) -> None:
    recipe = DQN(decisions=400, copies=1, hidden=32, batch=64, memory=5000, tau=0.1, behind=behind)
    compiled, torchs, env, entered = both(recipe, phase)
    practice = Practice(env, torchs, entered, crash_penalty=40.0)
    if behind:
        only(practice, torch.tensor([False, True, True, True, True]))
    practice.drive(60, 0.0)
    for _ in range(40):
        sample = torchs.buffer.sample()
        for each in (compiled, torchs):
            each.update(sample.clone(), 1e-3)
    for networks in ((compiled.policy, torchs.policy), (compiled.averaged(), torchs.averaged())):
        for own, other in zip(*(network.parameters() for network in networks), strict=True):
            torch.testing.assert_close(own, other, atol=1e-5, rtol=1e-4)
    begun, _, _ = learner(recipe, phase, compiled=True)
    learned = zip(begun.policy.parameters(), compiled.policy.parameters(), strict=True)
    assert max(float((before - after).abs().max()) for before, after in learned) > 1e-3


def test_a_compiled_dqn_explores_among_the_allowed_actions() -> None:
    recipe = DQN(decisions=400, copies=3, hidden=8, memory=500, behind="shield")
    found, env, _ = learner(recipe, 1, compiled=True)
    td = env.reset()
    td[ALLOWED] = torch.tensor([False, True, False, True, False]).expand(len(td), 5)
    for share in (1.0, 0.0):
        found.greedy.eps.fill_(share)
        seen = torch.cat([found.explore(td.clone())["action"] for _ in range(20)])
        assert set(seen.tolist()) <= {1, 3}
    found.greedy.eps.fill_(1.0)
    assert {1, 3} == set(torch.cat([found.explore(td.clone())["action"] for _ in range(20)]).tolist())


def test_hooks_that_change_what_is_learned_are_torchs() -> None:
    class Replaying(TrainingHooks):
        def replayed(self, observation: Tensor, policy: Any, share: float) -> Tensor:
            return observation

    class Acting(TrainingHooks):
        def acting(self, observation: Tensor, policy: Any, share: float, state: Any = None) -> Tensor:
            return observation

    assert Replaying().learns_otherwise
    assert not Acting().learns_otherwise
    assert not TrainingHooks().learns_otherwise
