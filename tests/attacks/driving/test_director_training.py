"""The world in which a director is trained is the victim's world."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from cavbench.attacks.driving.director_training import AdversaryWorld, Victim
from cavbench.attacks.driving.targets import EveryAction
from cavbench.core.pair import choose
from cavbench.driving import DrivingWorld, ObservationThreat
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.practice import roads
from cavbench.scenarios import SeedBlock


@pytest.fixture
def world() -> DrivingWorld:
    return choose("world", "highway").component


@pytest.mark.parametrize("kind", ["itself", "attacked"])
def test_the_world_of_a_director_drives_as_the_victims_world(kind: str, world: DrivingWorld) -> None:
    """Its measurements are those of the same actions in the victim's world, summed over the frames of a decision."""
    policy, repeat = DQN().load(0, world.facts), 3
    nothing = Victim(policy, ObservationThreat(), lambda observation, oracle, target: observation, seed=0)
    driver = EveryAction(5) if kind == "itself" else nothing
    cells = roads(world, 2)
    env = AdversaryWorld(world, "discrete", 5, driver).make(cells, action_repeat=repeat)
    plain = world.make(cells)
    seeds = SeedBlock.SELECT + torch.arange(len(cells))
    td, now = (each.reset(TensorDict({"seed": seeds}, batch_size=each.batch_size)) for each in (env, plain))
    for step in range(20):
        target = torch.full((len(cells),), (3, 1, 0)[step % 3])
        td = env.step(td.set("action", target))["next"]
        progress = torch.zeros(len(cells), 1)
        for _ in range(repeat):
            running = ~now["done"]
            action = target if kind == "itself" else policy.decide(now["observation"])
            now = plain.step(now.set("action", action))["next"]
            progress += now["info", "progress"] * running
        assert torch.equal(td["observation"], now["observation"])
        assert torch.equal(td["done"], now["done"])
        torch.testing.assert_close(td["info", "progress"], progress)
    assert kind == "attacked" or bool(now["info", "crashed"].any())


def test_finished_episodes_begin_again_one_by_one(world: DrivingWorld) -> None:
    cells = roads(world, 2)
    env = AdversaryWorld(world, "discrete", 5, EveryAction(5)).make(cells, action_repeat=5)
    env.set_seed(SeedBlock.TRAIN)
    td, began_again = env.reset(), 0
    for _ in range(60):
        step, td = env.step_and_maybe_reset(td.set("action", torch.full((len(cells),), 3)))
        ended = step["next", "done"].squeeze(-1)
        began_again += int(ended.sum())
        assert not td["done"].any()
        assert torch.equal(td["observation"][~ended], step["next", "observation"][~ended])
        if ended.any():
            assert not torch.equal(td["observation"][ended], step["next", "observation"][ended])
    assert began_again > len(cells)
