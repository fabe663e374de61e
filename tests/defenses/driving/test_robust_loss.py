"""The worst points of perturbation sets, and the losses of `sa` and `car` at them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench import zoo
from cavbench.core.pair import choose
from cavbench.defenses.driving.car import ConsistentAdversarialRobustness
from cavbench.defenses.driving.robust_loss import RobustLoss, RobustTraining
from cavbench.defenses.driving.sa import StateAdversarial
from cavbench.driving import Policy
from cavbench.driving.victims.ddpg import DDPG
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.training import LearningDriver
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from tests.attacks.driving.victims import observations

WORLD = HighwayWorld()
SHORT: dict[str, Any] = {"decisions": 160, "copies": 1, "hidden": 8, "batch": 16, "memory": 2000, "checkpoints": 1}
EVERY = pytest.mark.parametrize("defense", [StateAdversarial(), ConsistentAdversarialRobustness()], ids=["sa", "car"])


class Answering(Policy):
    """Its scores are a function of the observation."""

    def __init__(self, answer: Callable[[Tensor], Tensor], action_type: str = "discrete") -> None:
        super().__init__()
        self.answer, self.action_type = answer, action_type  # type: ignore[assignment]

    def forward(self, observation: Tensor) -> Tensor:
        return self.answer(observation)


def silent(share: float, text: str) -> None:
    """A progress callback that does nothing."""


def first(observation: Tensor) -> Tensor:
    """x of the first other car, [N]."""
    return observation[:, 1, 1]


def loss_of(
    defense: RobustLoss, policy: Policy, seen: Tensor, own: Callable[[TensorDictBase], Tensor], worst: Tensor
) -> Tensor:
    sample = TensorDict({"observation": seen}, [len(seen)])
    return defense.loss(policy, sample, own, lambda objective: worst)


def nothing(sample: TensorDictBase) -> Tensor:
    return torch.zeros(len(sample))


@EVERY
def test_the_worst_point_of_a_linear_objective_is_the_corner(defense: RobustLoss) -> None:
    seen = observations(8, 0)
    hooks = RobustTraining(defense, WORLD.facts, Answering(first), seed=0)
    hooks.replayed(seen, hooks.start, 1.0)
    slope = torch.randn(seen.shape, generator=torch.Generator().manual_seed(1))
    radius = hooks.threat.radius(seen, WORLD.facts.features)
    corner = (seen + radius * slope.sign()).clamp(-1, 1)
    torch.testing.assert_close(hooks.worst(seen, lambda at: (slope * at).sum((1, 2))), corner)


@EVERY
def test_the_set_grows_with_the_ramp(defense: RobustLoss) -> None:
    seen, hooks = observations(8, 0), RobustTraining(defense, WORLD.facts, Answering(first), seed=0)
    found = []
    for share in (0.0, defense.ramp_to / 2, defense.ramp_to, 1.0):
        hooks.replayed(seen, hooks.start, share)
        found.append(float((hooks.worst(seen, lambda at: at.sum((1, 2))) - seen).abs().amax()))
    assert found == pytest.approx([0.0, found[3] / 2, found[3], found[3]])
    assert found[3] > 0


def test_the_hinge_counts_the_lead_of_the_best_other_action_down_to_the_lead_that_is_enough() -> None:
    policy = Answering(lambda seen: torch.stack([first(seen), torch.zeros(len(seen)), -torch.ones(len(seen))], -1))
    seen, shown = (torch.zeros(3, 2, 5) for _ in range(2))
    seen[:, 1, 1] = 0.5
    shown[:, 1, 1] = torch.tensor([-0.3, 0.01, 0.4])
    found = loss_of(StateAdversarial(weight=2.0, lead=0.02), policy, seen, nothing, shown)
    torch.testing.assert_close(found, 2 * torch.tensor([0.3, -0.01, -0.02]))


def test_continuous_actions_are_kept_by_their_distance() -> None:
    policy = Answering(lambda seen: torch.stack([first(seen), 2 * first(seen)], -1), "continuous")
    seen, shown = torch.zeros(2, 2, 5), torch.zeros(2, 2, 5)
    shown[:, 1, 1] = torch.tensor([0.1, -0.2])
    found = loss_of(StateAdversarial(weight=1.0), policy, seen, nothing, shown)
    torch.testing.assert_close(found, 5**0.5 * torch.tensor([0.1, 0.2]))


@pytest.mark.parametrize(("temperature", "expected"), [(1e-3, 3.0), (1e6, 2.0)], ids=["largest", "mean"])
def test_car_goes_from_the_mean_to_the_largest_error_at_the_worst_points(temperature: float, expected: float) -> None:
    seen, worst = torch.zeros(2, 2, 5), torch.zeros(2, 2, 5)
    worst[:, 1, 1] = torch.tensor([1.0, 3.0])
    defense = ConsistentAdversarialRobustness(temperature=temperature)
    found = loss_of(defense, Answering(first), seen, lambda sample: first(sample["observation"]), worst)
    assert float(found) == pytest.approx(expected, rel=1e-3)


def test_car_needs_discrete_actions() -> None:
    with pytest.raises(UserError, match="discrete actions"):
        ConsistentAdversarialRobustness().train(DDPG(), WORLD, seed=0, progress=silent)


@pytest.mark.parametrize(
    ("defense", "victim"),
    [
        (StateAdversarial, DQN(**SHORT)),
        (StateAdversarial, DDPG(**SHORT)),
        (ConsistentAdversarialRobustness, DQN(**SHORT)),
    ],
    ids=["sa-dqn", "sa-ddpg", "car-dqn"],
)
def test_it_trains_saves_loads_and_changes_what_its_control_does_not(
    defense: type[RobustLoss], victim: LearningDriver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    monkeypatch.setattr(type(victim), "selection_episodes", 3)
    trained = victim.train(WORLD, seed=0, progress=silent)
    zoo.save(trained.network, zoo.Recipe.of(victim), seed=0, world=WORLD, card=trained.card)
    found = []
    for weight in (1.0, 0.0):
        robust = defense(weight=weight, decisions=160)
        ended = robust.train(victim, WORLD, seed=0, progress=silent)
        zoo.save(ended.network, zoo.Recipe.of(victim, robust), seed=0, world=WORLD, card=ended.card)
        loaded = robust.load(victim, 0, WORLD.facts)
        scores = loaded.scores(observations(8, 0))
        torch.testing.assert_close(scores, ended.network.scores(observations(8, 0)))
        assert set(ended.card["selection"]["safe_progress"]) == {"clean", "attacked"}
        found.append(scores)
    assert not torch.equal(*found)


@pytest.mark.parametrize("name", ["sa", "car"])
def test_what_has_no_training_has_nothing_to_load(name: str) -> None:
    defense = choose("defense", name).component
    with pytest.raises(UserError, match=f"{name} needs a victim that learns"):
        defense.load(choose("victim", "idm").component, 0, WORLD.facts)
