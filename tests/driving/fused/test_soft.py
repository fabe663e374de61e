"""Compiled SAC: the gradients of TorchRL's losses, and a learner that learns what torch's learns."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.driving.victims.learner import CHUNK
from cavbench.driving.victims.practice import ALLOWED, Practice
from cavbench.driving.victims.sac import SAC
from tests.driving.fused.both import both, only
from tests.driving.victims.test_networks import observation


def sample_of(count: int, seed: int) -> TensorDict:
    """Transitions [N], some of which end, where a part of the actions is allowed."""
    torch.manual_seed(seed)
    action = torch.randint(5, (count,))
    before, after = torch.rand(2, count, 5) < 0.6
    before.scatter_(1, action.unsqueeze(-1), True)
    after[:, seed % 5] = True
    ends = torch.rand(count, 1) < 0.3
    seen, next_seen = observation((count,), seed=seed), observation((count,), seed=seed + 1)
    following = {"reward": 2 * torch.randn(count, 1), "done": ends, "terminated": ends}
    now = {"observation": seen, "truth": seen, ALLOWED: before, "action": action}
    now["steps_to_next_obs"] = torch.randint(1, 4, (count, 1))
    return TensorDict({**now, "next": {**following, "observation": next_seen, ALLOWED: after}}, [count])


def opinionated(learner: Any) -> None:
    """Larger outputs: probabilities that differ, and values on both sides of where the critics' loss is clipped."""
    with torch.no_grad():
        for one in (learner.policy, learner.mean):
            one.network.head[-1].weight.mul_(20.0)


@pytest.mark.parametrize(
    ("count", "hidden", "critics", "behind"), [(1, 8, 1, ""), (65, 33, 2, "shield"), (300, 64, 1, "shield")]
)
@pytest.mark.parametrize("phase", [0, 1])
def test_the_gradients_of_an_update_are_those_of_torchrls_losses(
    count: int, hidden: int, critics: int, behind: str, phase: int
) -> None:
    """To 3e-6 in the networks, after the clipping; and the temperature after the update."""
    recipe = SAC(decisions=160, copies=1, hidden=hidden, critics=critics, behind=behind, temperature=0.3, memory=500)
    compiled, torchs, _, _ = both(recipe, phase)
    sample = sample_of(count, seed=count)
    for each in (compiled, torchs):
        opinionated(each)
        each.rule.update(sample.clone(), 0.0)
        each.rule.inform()
    learning, loss = compiled.rule.learning, torchs.rule.loss
    actor = torch.cat([weight.grad.reshape(-1) for weight in torchs.policy.network.fused._weights()])
    found = torch.from_numpy(learning.actor.by_weights)
    torch.testing.assert_close(found * min(1.0, 10 / float(found.norm())), actor, atol=3e-6, rtol=1e-4)
    assert float(actor.abs().max()) > 1e-3
    names = ["encoder.car.weight", "encoder.car.bias", "encoder.ego.weight", "encoder.pair.weight", "encoder.pair.bias"]
    names += [f"head.{layer}.{part}" for layer in (0, 2, 4) for part in ("weight", "bias")]
    grads = loss.qvalue_network_params.flatten_keys(".")
    whole = math.hypot(*(float(torch.from_numpy(critic.by_weights).norm()) for critic in learning.critics))
    for number, critic in enumerate(learning.critics):
        expected = torch.cat([grads[f"module.{name}"].grad[number].reshape(-1) for name in names])
        found = torch.from_numpy(critic.by_weights) * min(1.0, 10 / whole)
        torch.testing.assert_close(found, expected, atol=3e-6, rtol=1e-4)
    torch.testing.assert_close(compiled.policy.temperature, torchs.policy.temperature, atol=1e-6, rtol=1e-5)
    assert abs(float(torchs.policy.temperature) - 0.3) > 1e-4


@pytest.mark.parametrize(("phase", "behind", "critics"), [(0, "", 1), (1, "", 1), (1, "shield", 2)])
def test_a_sac_learns_what_it_learns_with_torch(phase: int, behind: str, critics: int) -> None:
    """The same batches: after 40 updates all weights differ by less than 1 % of what they have moved by."""
    recipe = SAC(decisions=400, copies=1, hidden=32, batch=64, memory=5000, tau=0.1, behind=behind, critics=critics)
    compiled, torchs, env, entered = both(recipe, phase)
    begun = copy.deepcopy(torchs.policy.state_dict())
    practice = Practice(env, torchs, entered, crash_penalty=40.0)
    if behind:
        only(practice, torch.tensor([False, True, True, True, True]))
    practice.drive(60, 0.0)
    for _ in range(40 // CHUNK):
        for _ in range(CHUNK):
            sample = torchs.buffer.sample()
            sample["truth"] = sample["observation"]
            for each in (compiled, torchs):
                each.update(sample.clone(), 1e-3)
        for each in (compiled, torchs):
            each.anneal()
    after = torchs.policy.state_dict()
    moved = max(float((begun[name] - after[name]).abs().max()) for name in begun)
    assert moved > 1e-2
    for own, other in zip(*(weights_of(each, 2 if behind else 1) for each in (compiled, torchs)), strict=True):
        torch.testing.assert_close(own, other, atol=1e-2 * moved, rtol=1e-3)


def weights_of(learner: Any, without: int) -> Iterator[Tensor]:
    """The weights of the policy with its critics and temperature, and their averages, but for rows of the actor's last layer.

    The first row is the state's value, the second that of an action that is never allowed. The softmax does not depend on
    them. Their gradient is rounding, of which Adam makes whole steps.
    """
    for policy in (learner.policy, learner.averaged()):
        for name, value in policy.state_dict().items():
            yield value[without:] if name.startswith("network.head.4.") else value


def test_a_compiled_sac_draws_among_the_allowed_actions() -> None:
    compiled, _, env, _ = both(SAC(decisions=400, copies=1, hidden=8, memory=500, behind="shield"), 1)
    td = torch.cat([env.reset()] * 10)
    td[ALLOWED] = torch.tensor([False, True, False, True, False]).expand(len(td), 5)
    assert set(compiled.rule.actor(td)["action"].tolist()) == {1, 3}
    assert "action_log_prob" not in td
