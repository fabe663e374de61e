"""A frame stack returns the mean or median of the last frames, for any victim, batch and order of queries."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.attacks.driving.noise import Noise
from cavbench.core.pair import choose
from cavbench.defenses.driving.frame_stack import FrameStack, Reduction
from cavbench.driving import ObservationThreat, Policy
from cavbench.driving.rollout import Trace, rollout
from cavbench.driving.victims.reference import Blind, RandomDriver
from cavbench.envs.highway.world import HighwayWorld
from cavbench.scenarios import SeedBlock
from tests.attacks.driving.victims import observations, victim
from tests.driving.policies import FACTS, STATEFUL, Echo, Given, stacked

EPISODES = 3
REDUCTIONS: tuple[Reduction, ...] = ("mean", "median")
every_reduction = pytest.mark.parametrize("reduce", REDUCTIONS)


def frames(count: int, episodes: int = EPISODES) -> list[Tensor]:
    """Observations [episodes, V, F] of `count` steps, in which rows come and go."""
    return [observations(episodes, seed) for seed in range(count)]


def shown(policy: Policy, steps: list[Tensor]) -> list[Tensor]:
    """What reaches the inner `Echo` at each step, [episodes, V, F]."""
    state, found = policy.initial(torch.arange(len(steps[0]))), []
    for observation in steps:
        found.append(policy.scores(observation, state).unflatten(-1, observation.shape[-2:]))
        state = policy.advance(observation, policy.decide(observation, state), state)
    return found


def by_hand(steps: list[Tensor], count: int, reduce: Reduction) -> np.ndarray:
    """[episodes, V, F] what is shown last: NumPy over the last `count` frames, of which there are always enough."""
    window = np.stack([each.numpy() for each in [steps[0]] * count + steps][-count:]).astype(np.float64)
    window[..., 1:] = np.where(window[..., :1] > 0, window[..., 1:], np.nan)
    now, expected = steps[-1].numpy(), steps[-1].numpy().astype(np.float64)
    reduced = np.nanmean if reduce == "mean" else np.nanmedian
    for place in np.argwhere(now[..., 0] > 0):
        expected[(*place, slice(1, None))] = reduced(window[(slice(None), *place, slice(1, None))], axis=0)
    return expected


@every_reduction
@settings(max_examples=25, deadline=None)
@given(count=st.integers(2, 6), steps=st.integers(1, 9))
def test_the_victim_sees_the_reduction_of_the_last_frames(reduce: Reduction, count: int, steps: int) -> None:
    seen = frames(steps)
    found = shown(stacked(Echo(), count, reduce), seen)[-1]
    np.testing.assert_allclose(found, by_hand(seen, count, reduce), atol=1e-6)


@every_reduction
def test_the_first_step_is_the_observation_itself(reduce: Reduction) -> None:
    (first,) = frames(1)
    torch.testing.assert_close(shown(stacked(Echo(), 3, reduce), [first])[0], first, rtol=0, atol=0)


@every_reduction
def test_presence_is_current_and_absent_rows_stay_empty(reduce: Reduction) -> None:
    seen = frames(6)
    for now, found in zip(seen, shown(stacked(Echo(), 4, reduce), seen), strict=True):
        torch.testing.assert_close(found[..., 0], now[..., 0], rtol=0, atol=0)
        assert not found[now[..., 0] == 0].any()
        assert found.isfinite().all()


@every_reduction
def test_a_newly_visible_car_has_its_true_position(reduce: Reduction) -> None:
    """An absent row holds zeros, the ego's own place: they are no measurement."""
    empty = torch.zeros(1, 2, 5)
    empty[:, 0, 0] = 1.0
    there = empty.clone()
    there[:, 1] = torch.tensor([1.0, 0.8, 0.2, -0.1, 0.0])
    found = shown(stacked(Echo(), 4, reduce), [empty, empty, there])[-1]
    torch.testing.assert_close(found, there, rtol=0, atol=0)


@every_reduction
def test_gradients_reach_the_newest_frame_and_are_finite(reduce: Reduction) -> None:
    policy, seen = stacked(victim("discrete"), 4, reduce), frames(5)
    state = policy.initial(torch.arange(EPISODES))
    for observation in seen[:-1]:
        state = policy.advance(observation, policy.decide(observation, state), state)
    leaf = seen[-1].clone().requires_grad_()
    policy.scores(leaf, state).sum().backward()
    assert leaf.grad is not None
    assert leaf.grad.isfinite().all()
    assert leaf.grad.flatten(1).any(1).any()


@pytest.mark.parametrize("victim_", [Blind(), RandomDriver(), RandomDriver(actions="continuous")], ids=repr)
def test_the_victims_own_state_is_kept(victim_: Blind | RandomDriver) -> None:
    alone, behind = victim_.load(0, FACTS), FrameStack(frames=3).load(victim_, 0, FACTS)
    episodes = torch.tensor([5, 6, 7])
    own, state = alone.initial(episodes), behind.initial(episodes)
    for observation in frames(70):
        action = alone.decide(observation, own)
        torch.testing.assert_close(behind.decide(observation, state), action, rtol=0, atol=0)
        own, state = alone.advance(observation, action, own), behind.advance(observation, action, state)


def test_the_victims_attributes_are_passed_on() -> None:
    for name in ("dqn", "idm"):
        own = choose("victim", name).component
        alone, behind = own.load(0, FACTS), FrameStack().load(own, 0, FACTS)
        for value in ("action_type", "driver", "weights_sha256", "training"):
            assert getattr(behind, value) == getattr(alone, value)


@every_reduction
@settings(max_examples=15, deadline=None)
@given(count=st.integers(2, 9), start=st.integers(0, 15), size=st.integers(1, 16))
def test_an_episode_is_the_same_in_any_batch(reduce: Reduction, count: int, start: int, size: int) -> None:
    seen = frames(6, 32)
    part = slice(start, start + size)
    policy = stacked(Echo(), count, reduce)
    whole, alone = shown(policy, seen), shown(policy, [each[part] for each in seen])
    for every, some in zip(whole, alone, strict=True):
        torch.testing.assert_close(every[part], some, rtol=0, atol=0)


@every_reduction
def test_on_the_highway_the_victim_decides_on_the_frames_it_was_shown(reduce: Reduction) -> None:
    """Every step of real attacked episodes, recomputed from what their trace says was shown."""
    world = HighwayWorld()
    inner = choose("victim", "dqn").component.load(0, FACTS)
    policy = FrameStack(frames=3, reduce=reduce).load(Given(policy=inner), 0, FACTS)
    seeds = range(SeedBlock.TUNE, SeedBlock.TUNE + 4)
    env = world.make([world.axes.cell(lanes=3, density=1.0)] * len(seeds))
    trace = Trace(range(len(seeds)))
    rollout(env, policy, Noise(), ObservationThreat(), seeds, facts=world.facts, attack_seed=0, trace=trace)
    steps = [torch.from_numpy(each) for each in trace.steps["perturbed"]]
    assert len(steps) > 30
    for t, scores in enumerate(trace.steps["scores"]):
        smoothed = torch.from_numpy(by_hand(steps[max(0, t - 2) : t + 1], 3, reduce)).float()
        with torch.no_grad():
            expected = inner.scores(smoothed)
        running = trace.steps["running"][t]
        np.testing.assert_allclose(scores[running], expected[torch.from_numpy(running)], atol=1e-4)


@pytest.mark.parametrize("name", STATEFUL)
def test_components_with_a_state_do_not_depend_on_the_batch(name: str) -> None:
    def columns(seeds: range) -> dict[str, np.ndarray]:
        world, policy = HighwayWorld(), STATEFUL[name]()
        env = world.make([world.axes.cell(lanes=3, density=1.0)] * len(seeds), action_type=policy.action_type)
        return rollout(env, policy, None, ObservationThreat(), seeds, facts=world.facts, attack_seed=0)

    together = columns(range(SeedBlock.TUNE, SeedBlock.TUNE + 3))
    for place, seed in enumerate(together["seed"]):
        alone = columns(range(int(seed), int(seed) + 1))
        for column in ("steps", "return", "safe_progress", "crashed", "distance_m", "action_counts"):
            np.testing.assert_array_equal(alone[column][0], together[column][place], err_msg=column)
