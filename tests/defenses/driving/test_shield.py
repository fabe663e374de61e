"""The shield: a shielded driver hits no car that keeps to the assumptions, and attacks reach the victim through it."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict

from cavbench.attacks.driving.noise import Noise
from cavbench.attacks.driving.pgd import PGD
from cavbench.core.pair import choose
from cavbench.defenses.driving.shield import Shield, Shielded, ShieldedControls
from cavbench.defenses.driving.tracker import Tracked, Tracker
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from tests.driving.intervals.drivers import FACTS, FAST, SEEDS, WORLD, Fastest, Pushing, driven, roads


@pytest.mark.parametrize("attack", [None, Noise(), PGD(objective="target", target_action=FAST, steps=3, restarts=1)])
def test_the_shield_holds_the_guarantee_in_the_engine(attack: Any) -> None:
    """Behind a single car, which never brakes, a driver that only accelerates does not crash, whatever it is shown."""
    world = HighwayWorld(vehicles=1, max_steps=120)
    policy = Shielded(Shield(), Fastest(), world.facts)
    columns = driven(world, policy, attack, lanes=2)
    assert not columns["crashed"].any()
    assert (columns["assured"] > (0.6 if attack else 0.98)).all()
    assert (columns["mean_speed"] > 20).all()


@pytest.mark.parametrize("steering", [0.0, 1.0])
@pytest.mark.parametrize("attack", [None, Noise(), PGD(objective="target", steps=3, restarts=1)])
def test_the_shield_of_continuous_controls_holds_the_guarantee_in_the_engine(attack: Any, steering: float) -> None:
    """Behind a single car, at full throttle and full lock: neither a crash nor a way off the road."""
    world = HighwayWorld(vehicles=1, max_steps=120)
    policy = ShieldedControls(Shield(), Pushing(1.0, steering), world.facts)
    columns = driven(world, policy, attack, lanes=2)
    assert not columns["crashed"].any()
    assert not columns["offroad"].any()
    # At the least distance that is safe, noise decides from frame to frame.
    assert (columns["assured"] > (0.4 if attack else 0.98)).all()
    assert (columns["mean_speed"] > 20).all()


def test_continuous_actions_are_projected_onto_what_passes() -> None:
    env = HighwayWorld().make([AXES.cell(lanes=3, density=1.0)] * len(SEEDS), action_type="continuous")
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    policy = Tracked(Tracker(), ShieldedControls(Shield(), Pushing(0.3, -0.6), FACTS), FACTS)
    state = policy.initial(torch.tensor(SEEDS))
    clipped = 0
    for _ in range(60):
        shown = td["observation"].clone().requires_grad_(True)
        action, passed = policy.decide(shown, state), policy.passed(shown, state)
        wanted, allowed = policy.policy.policy.scores(passed.observation), passed.allowed
        assert allowed is not None
        expected = wanted.clamp(allowed[:, 0], allowed[:, 1])
        torch.testing.assert_close(action, expected)
        clipped += int((expected != wanted).sum())
        (gradient,) = torch.autograd.grad(action.sum(), shown)
        assert bool(gradient.isfinite().all())
        assert bool((gradient.abs().amax((1, 2)) > 0).all())
        state = policy.advance(shown.detach(), action.detach(), state)
        td = env.step(td.set("action", action.detach()))["next"]
    assert clipped > 60


def test_only_allowed_actions_win() -> None:
    env = roads(WORLD)
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    policy = Tracked(Tracker(), Shielded(Shield(), Fastest(), FACTS), FACTS)
    state = policy.initial(torch.tensor(SEEDS))
    masked = 0
    for _ in range(60):
        action, passed = policy.decide(td["observation"], state), policy.passed(td["observation"], state)
        assert passed.allowed is not None
        assert bool(passed.allowed.gather(1, action.unsqueeze(1)).all())
        masked += int((~passed.allowed[:, FAST]).sum())
        state = policy.advance(td["observation"], action, state)
        td = env.step(td.set("action", action))["next"]
    assert masked > 0


def test_only_the_filter_keeps_that_driver_from_crashing() -> None:
    world = HighwayWorld(max_steps=120)
    bare = driven(world, Fastest(), None)
    shielded = driven(world, Shielded(Shield(), Fastest(), world.facts), None)
    assert bare["crashed"].mean() > 0.5
    assert shielded["crashed"].mean() <= 0.17


def test_the_gradient_passes_the_filter_and_reaches_the_victim() -> None:
    policy = Shielded(Shield(), Fastest(), FACTS)
    env = roads(WORLD)
    td = env.reset(TensorDict({"seed": torch.tensor(SEEDS)}, batch_size=env.batch_size))
    shown = td["observation"].clone().requires_grad_(True)
    scores = policy.scores(shown, policy.initial(torch.tensor(SEEDS)))
    (gradient,) = torch.autograd.grad(scores[:, FAST].sum(), shown)
    assert bool(gradient.isfinite().all())
    assert bool((gradient[:, 1:, 1:].abs().amax((1, 2)) > 0).all())


def test_a_blind_driver_is_refused_in_one_line() -> None:
    blind = choose("victim", "blind", policy="faster").component
    with pytest.raises(UserError, match="sees") as refused:
        Shield().load(blind, 0, FACTS)
    assert "\n" not in str(refused.value)
