"""Two-stage: the director's choice is what the attack induces, and one driver serves all victims with the same actions."""

from __future__ import annotations

import torch

from cavbench import zoo
from cavbench.attacks.driving.pgd import PGD
from cavbench.attacks.driving.targets import Controls
from cavbench.attacks.driving.two_stage import TwoStage
from cavbench.defenses.driving.advtrain import AdversarialTraining
from cavbench.defenses.none import NoDefense
from cavbench.driving.victims.ddpg import DDPG
from cavbench.driving.victims.dqn import DQN
from tests.attacks.driving.directors import Preferring
from tests.attacks.driving.victims import observations, perturb, victim


def test_the_best_action_that_can_be_induced_is_taken() -> None:
    """The attack does as well as PGD towards each single action, by the director's ranking."""
    policy, seen, order = victim("discrete", 3), observations(40, 3), (2, 4, 0, 3, 1)
    values = [float(-order.index(action)) for action in range(5)]
    attack = TwoStage(steps=10, restarts=4).armed(Preferring(*values))
    taken = policy.decide(perturb(attack, policy, seen)[0])
    rank = torch.tensor([order.index(int(action)) for action in taken])
    alone = [
        policy.decide(perturb(PGD(objective="target", target_action=action), policy, seen)[0]) == action
        for action in order
    ]
    best_alone = torch.stack(alone).int().argmax(0)
    assert rank.float().mean() <= best_alone.float().mean()
    assert (rank < torch.tensor([order.index(int(action)) for action in policy.decide(seen)])).any()


def test_a_continuous_victim_is_pulled_towards_the_preferred_control() -> None:
    policy, seen = victim("continuous", 2), observations(40, 2)
    controls = Controls(0.5)
    for target in (0, 4, 8):
        values = [float(number == target) for number in range(controls.count)]
        attack = TwoStage(steering=0.5, steps=10).armed(Preferring(*values))
        wanted = controls.action(torch.tensor(target))
        before, after = (
            (policy.decide(shown) - wanted).norm(dim=-1).mean() for shown in (seen, perturb(attack, policy, seen)[0])
        )
        assert after < before


def test_the_driver_of_two_stage_is_shared_by_all_victims_with_the_same_actions() -> None:
    first = zoo.Recipe.of(DQN(), NoDefense(), TwoStage())
    second = zoo.Recipe.of(DQN(hidden=64), AdversarialTraining(), TwoStage())
    assert first.key == second.key
    assert second.train(0) == "bench train victim=dqn defense=advtrain attack=two_stage victim.hidden=64 seeds=0"
    assert zoo.Recipe.of(DDPG(), NoDefense(), TwoStage()).key != first.key
