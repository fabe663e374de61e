"""The episodes in which a driver of the traffic is trained, and what it learns in a few seconds."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from cavbench.attacks.driving import rival_training
from cavbench.attacks.driving.rival import Rival
from cavbench.attacks.driving.rival_seat import ACTIONS, SIDES
from cavbench.attacks.driving.rival_training import Duel, Student, collected, train
from cavbench.core.pair import choose
from cavbench.defenses.none import NoDefense
from cavbench.driving import DrivingWorld
from cavbench.driving.sets import Traffic
from cavbench.driving.traffic import View
from cavbench.driving.victims.dqn import DQN
from cavbench.envs.highway.axes import AXES
from cavbench.errors import UserError

CELLS = [AXES.cell(lanes=lanes, density=2.0) for lanes in (3, 4) for _ in range(6)]
RECIPE = Rival(hidden=8, rollout=4, batch=64)
ROLL = 2 * SIDES + 1
"""Neither accelerates nor changes place."""


@pytest.fixture
def world() -> DrivingWorld:
    return choose("world", "highway").component


def duel(world: DrivingWorld, recipe: Rival = RECIPE) -> Duel:
    env = world.make(CELLS, traffic=Traffic(cars=recipe.cars))
    env.set_seed(10_000_000)
    return Duel(env, NoDefense().load(DQN(), 0, world.facts), recipe)


@torch.no_grad()
def test_the_reward_is_minus_the_progress_and_more_for_a_crash(world: DrivingWorld) -> None:
    practice = duel(world)
    crashes = 0
    for _ in range(40):
        found = practice.step(torch.full((len(CELLS), 1), ROLL))
        worth, failed = found["reward"] * RECIPE.repeat / (1 - RECIPE.gamma), found["terminated"]
        crashes += int(failed.sum())
        # A frame is worth at most 1.
        assert bool((worth[failed] <= RECIPE.crash + 1e-3).all())
        assert bool((worth[failed] > RECIPE.crash - RECIPE.repeat - 1e-3).all())
        assert bool((worth[~failed] <= 0).all())
        assert bool((worth[~failed] >= -RECIPE.repeat - 1e-3).all())
    assert practice.crashes == crashes > 0


@torch.no_grad()
def test_what_ends_begins_anew_with_other_cars(world: DrivingWorld) -> None:
    practice = duel(world)
    practice.seats["car"][:] = 20
    done = torch.zeros(len(CELLS), dtype=torch.bool)
    for _ in range(90):
        done = practice.step(torch.full((len(CELLS), 1), ROLL))["done"][:, 0, 0]
        if bool(done.any()):
            break
    assert bool(done.any())
    assert not bool(practice.td["done"].any())
    assert bool((practice.view.driven[done] == 0).all())
    assert bool((practice.seats["acceleration"][done] == 0).all())


@torch.no_grad()
def test_the_world_lets_it_drive_so_many_cars_as_the_recipe_says(world: DrivingWorld) -> None:
    practice = duel(world, Rival(cars=2, hidden=8, rollout=4))
    for _ in range(6):
        practice.step(torch.randint(ACTIONS, (len(CELLS), 2)))
        assert int(practice.view.driven.sum(1).max()) <= 2
    assert int(practice.view.driven.sum(1).max()) == 2
    experience = collected(practice, Student(practice.recipe), 4)
    assert experience.shape == (2 * len(CELLS), 4)


def test_an_update_makes_rewarded_choices_more_likely(world: DrivingWorld) -> None:
    torch.manual_seed(0)
    practice = duel(world)
    student = Student(replace(RECIPE, learning_rate=0.01))
    experience = collected(practice, student, 4)
    good = experience["action"] == 5
    experience["next", "reward"] = good.unsqueeze(-1).float()
    seen = experience["observation"].reshape(-1, *experience["observation"].shape[-2:])
    with torch.no_grad():
        before = student.policy.network(seen).softmax(-1)[:, 5].mean()
    for _ in range(5):
        student.learn(experience.clone(), 1.0)
    with torch.no_grad():
        after = student.policy.network(seen).softmax(-1)[:, 5].mean()
    assert after > 1.2 * before


def test_a_training_in_which_nobody_drove_is_refused(world: DrivingWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    practice = duel(world)
    student = Student(RECIPE)
    before = [weight.clone() for weight in student.policy.parameters()]
    experience = collected(practice, student, 1)
    experience["valid"][:] = False
    for driven in (0, 1):
        experience["valid"][:driven] = True
        student.learn(experience.clone(), 1.0)
    torch.testing.assert_close(list(student.policy.parameters()), before, rtol=0, atol=0)
    monkeypatch.setattr(rival_training, "collected", lambda *_: experience.clone())
    with pytest.raises(UserError, match="no car of the traffic came near the victim"):
        train(practice, lambda *_: None)


@pytest.mark.parametrize(("name", "value"), [("gamma", 1.0), ("crash", 1e38), ("learning_rate", 1e30)])
def test_parameters_with_which_nothing_can_be_learned_are_refused(name: str, value: float) -> None:
    """At a discount of 1 every reward would be 0; the others overflow."""
    with pytest.raises(ValueError, match=f"{name} must be"):
        Rival(**{name: value})


def test_the_view_is_that_of_the_world(world: DrivingWorld) -> None:
    practice = duel(world)
    assert isinstance(practice.view, View)
    assert practice.see().shape[:2] == (len(CELLS), 1)
