"""Compiled PPO: TorchRL's advantages and gradients, and a learner that learns what torch's learns."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.objectives.value import GAE

from cavbench.driving.fused.proximal import advantages
from cavbench.driving.victims.learner import CHUNK
from cavbench.driving.victims.ppo import PPO
from cavbench.driving.victims.practice import ALLOWED, Practice
from tests.driving.fused.both import both, only, parameters_of
from tests.driving.victims.test_networks import observation


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("gamma", "trace"), [(0.97, 0.85), (1.0, 1.0), (0.9, 0.0)])
def test_advantages_are_those_of_torchrl(seed: int, gamma: float, trace: float) -> None:
    torch.manual_seed(seed)
    shape = (4, 30, 1)
    done = torch.rand(shape) < 0.2
    terminated = done & (torch.rand(shape) < 0.5)
    after = {"reward": torch.randn(shape), "done": done, "terminated": terminated, "state": torch.randn(shape)}
    decisions = TensorDict({"state": torch.randn(shape), "next": after}, [4, 30])
    value = TensorDictModule(torch.nn.Identity(), in_keys=["state"], out_keys=["state_value"])
    expected = GAE(gamma=gamma, lmbda=trace, value_network=value)(decisions.clone())
    given = (one.squeeze(-1) for one in (decisions["state"], *(after[name] for name in ("state", "reward", "done"))))
    found = advantages(*given, terminated.squeeze(-1), gamma=gamma, trace=trace).unsqueeze(-1)
    torch.testing.assert_close(found, expected["advantage"], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(found + decisions["state"], expected["value_target"], atol=1e-5, rtol=1e-5)


def sample_of(count: int, actions: int, seed: int) -> TensorDict:
    """Decisions [N], many of which are clipped, and of which each policy may have done only the allowed ones."""
    torch.manual_seed(seed)
    seen = observation((count,), seed=seed)
    allowed = torch.rand(count, actions) < 0.6
    action = torch.randint(actions, (count,))
    allowed.scatter_(1, action.unsqueeze(-1), True)
    wide = {name: torch.randn(count, 1) for name in ("advantage", "value_target")}
    log_prob = (torch.tensor(0.5 / actions).log() + 0.5 * torch.randn(count)).clamp_max(-0.01)
    return TensorDict(
        {"observation": seen, ALLOWED: allowed, "action": action, "action_log_prob": log_prob, **wide}, [count]
    )


@pytest.mark.parametrize("behind", ["", "shield"])
@pytest.mark.parametrize(("count", "hidden", "entropy"), [(1, 8, 0.5), (64, 16, 0.0), (200, 33, 0.02), (515, 128, 0.1)])
def test_the_gradients_of_an_update_are_those_of_torchrls_loss(
    count: int, hidden: int, entropy: float, behind: str
) -> None:
    """To 3e-6, where the largest slope is about 1."""
    recipe = PPO(decisions=160, copies=1, hidden=hidden, behind=behind)
    compiled, torchs, _, _ = both(recipe, 0)
    sample = sample_of(count, 5, seed=count)
    for each in (compiled, torchs):
        each.rule.weigh(entropy)
        with torch.no_grad():
            # A policy that has opinions.
            each.policy.network.head[-1].weight.mul_(30.0)
        each.rule.update(sample.clone(), (0.0, 0.0))
    learning = compiled.rule.learning
    for ours, network in ((learning.actor, torchs.policy.network), (learning.critic, torchs.critic)):
        expected = torch.cat([weight.grad.reshape(-1) for weight in network.fused._weights()])
        # Torch has clipped its gradients in place.
        found = torch.from_numpy(ours.by_weights)
        found = found * min(1.0, 0.5 / float(found.norm()))
        assert float(expected.abs().max()) > 1e-3
        torch.testing.assert_close(found, expected, atol=3e-6, rtol=1e-4)


@pytest.mark.parametrize(("phase", "behind"), [(0, ""), (1, ""), (1, "shield")])
def test_a_ppo_learns_what_it_learns_with_torch(phase: int, behind: str) -> None:
    """The same decisions: after 24 rounds of updates all weights differ by less than 1e-4 of what they have moved by."""
    short = {"decisions": 400, "copies": 1, "hidden": 32, "batch": 40, "rollout": 16, "tau": 0.1, "settling": 1}
    recipe = PPO(**short, fine_rollout=16, fine_batch=40, behind=behind)
    compiled, torchs, env, entered = both(recipe, phase)
    begun = copy.deepcopy([*parameters_of(torchs)])
    practice = Practice(env, torchs, entered, crash_penalty=40.0)
    if behind:
        only(practice, torch.tensor([False, True, True, True, True]))
    for number in range(6):
        chunks: list[Any] = []
        torchs.collect = chunks.append
        for _ in range(2):
            practice.drive(CHUNK, 0.1 * number)
        for each in (compiled, torchs):
            torch.manual_seed(number)
            each.chunks = [chunk.clone() for chunk in chunks]
            each.learn(1e-3, 0.1 * number)
    moved = max(float((a - b).abs().max()) for a, b in zip(begun, parameters_of(torchs), strict=True))
    assert moved > 3e-3
    for own, other in zip(parameters_of(compiled), parameters_of(torchs), strict=True):
        torch.testing.assert_close(own, other, atol=1e-4 * moved, rtol=1e-4)
    for own, other in zip(compiled.averaged().parameters(), torchs.averaged().parameters(), strict=True):
        torch.testing.assert_close(own, other, atol=1e-4 * moved, rtol=1e-4)


def test_a_compiled_ppo_draws_among_the_allowed_actions() -> None:
    compiled, torchs, env, _ = both(PPO(decisions=160, copies=1, hidden=8, behind="shield"), 1)
    td = torch.cat([env.reset()] * 10)
    td[ALLOWED] = torch.tensor([False, True, False, True, False]).expand(len(td), 5)
    for each in (compiled, torchs):
        with set_exploration_type(ExplorationType.RANDOM):
            seen = each.explore(td.clone())
        assert set(seen["action"].tolist()) == {1, 3}
        expected = torch.distributions.Categorical(
            logits=each.policy.scores(td["observation"]).masked_fill(~td[ALLOWED], -1e4)
        )
        torch.testing.assert_close(seen["action_log_prob"], expected.log_prob(seen["action"]))
