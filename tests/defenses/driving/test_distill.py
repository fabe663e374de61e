"""Distillation: what the student learns, what an attack is told, and how attacks fare when that hides the gradients."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench import zoo
from cavbench.core import registry
from cavbench.core.pair import choose
from cavbench.defenses.driving.distill import Distillation, Lessons, Probabilities, highest, labels
from cavbench.driving import DrivingVictim, ObservationThreat, Policy
from cavbench.driving.access import Enforcer
from cavbench.driving.bounds.intervals import leads
from cavbench.driving.bounds.networks import BoundedNetwork
from cavbench.driving.policy import PolicyWrapper
from cavbench.driving.threat import bounds
from cavbench.driving.victim import CountedPolicy
from cavbench.driving.victims.ddpg import DDPG
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.networks import QPolicy
from cavbench.driving.victims.ppo import PPO
from cavbench.driving.victims.sac import SAC
from cavbench.driving.victims.training import LearningDriver
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from tests.attacks.driving.victims import observations
from tests.driving.victims.learners import REPLAYED, SHORT, silent

WORLD = HighwayWorld()
SCORES = st.lists(st.integers(-100, 100), min_size=5, max_size=5, unique=True)


def dqn() -> QPolicy:
    """The trained teacher."""
    policy = choose("victim", "dqn").component.load(0, WORLD.facts)
    assert isinstance(policy, QPolicy)
    return policy


class Times(PolicyWrapper):
    """A policy with its scores times a number."""

    def __init__(self, policy: Policy, factor: float) -> None:
        super().__init__(policy)
        self.factor = factor

    def scores(self, observation: Tensor, state: object = None) -> Tensor:
        return self.policy.scores(observation) * self.factor


def shown(policy: Policy, seen: Tensor) -> tuple[Tensor, float]:
    """What `pgd` shows instead of [N, V, F], and the share of its gradients that are 0 everywhere."""
    attack = registry.load("attack", "pgd")(objective="margin")
    enforcer = Enforcer(
        CountedPolicy(policy),
        ObservationThreat(),
        attack.access,
        WORLD.facts.features,
        torch.Generator().manual_seed(0),
    )
    oracle = enforcer.begin(seen, None)
    found = enforcer.project(attack.perturb(seen, oracle))[0]
    asked, zero, _ = enforcer.gradients.counts.sum(1).tolist()
    return found, zero / asked


@given(SCORES, st.floats(0.1, 100), st.floats(-10, 10))
def test_labels_do_not_depend_on_the_scale_or_offset_of_the_scores(
    scores: list[int], scale: float, offset: float
) -> None:
    own = torch.tensor([scores]).double()
    torch.testing.assert_close(labels(own, 20.0), labels(scale * own + offset, 20.0), rtol=1e-4, atol=1e-6)


def test_scores_that_are_all_the_same_make_every_action_as_likely() -> None:
    for score in (0.0, 0.5, 1e4):
        torch.testing.assert_close(labels(torch.full((1, 5), score), 20.0), torch.full((1, 5), 0.2))


@given(SCORES)
def test_labels_soften_with_the_temperature_from_the_decision_alone_to_all_alike(scores: list[int]) -> None:
    own = torch.tensor([scores]).double()
    found = torch.cat([labels(own, temperature) for temperature in (0.0, 1.0, 20.0, 1e6)])
    assert (found.argmax(-1) == own.argmax()).all()
    assert (found[0] == torch.nn.functional.one_hot(own.argmax(), 5)).all()
    assert (found.amax(-1).diff() <= 0).all()
    torch.testing.assert_close(found.sum(-1), torch.ones(4).double())
    torch.testing.assert_close(found[-1], torch.full((5,), 0.2).double(), atol=1e-3, rtol=0)


@pytest.mark.parametrize("temperature", [0.0, 20.0])
def test_the_loss_is_lowest_for_a_student_that_decides_like_the_teacher(temperature: float) -> None:
    teacher, seen = dqn(), observations(64, 0)
    hooks = Lessons(Distillation(temperature=temperature), teacher, WORLD.facts.features, seed=0)
    student, sample = hooks.start, TensorDict({"observation": seen}, [64])
    adam = torch.optim.Adam(student.parameters(), 3e-3)

    def own(sample: TensorDictBase) -> Tensor:
        raise AssertionError("the victim's own loss does not count")

    def agreement() -> float:
        return float((student.decide(seen) == teacher.decide(seen)).float().mean())

    before = agreement()
    for _ in range(150):
        adam.zero_grad()
        hooks.loss(student, sample, own).mean().backward()
        adam.step()
    assert before < 0.6 < 0.85 < agreement()


@pytest.mark.parametrize("budget", [0.0, 0.02, 0.2])
def test_no_point_of_the_set_has_a_higher_loss_than_the_bound(budget: float) -> None:
    torch.manual_seed(0)
    policy, seen = QPolicy(5, 5, 16), observations(32, 0)
    wanted = torch.softmax(torch.randn(32, 5), -1)
    low, high = bounds(seen, ObservationThreat(budget=budget).radius(seen, WORLD.facts.features))
    points = low + (high - low) * torch.rand(500, *seen.shape).round()
    found = -(wanted * policy.scores(points).log_softmax(-1)).sum(-1)
    bound = highest(wanted, leads(policy.network, low, high))
    assert (found <= bound + 1e-5).all()
    if budget == 0:
        torch.testing.assert_close(found[0], bound)


def test_learning_with_bounds_makes_decisions_provable() -> None:
    teacher, seen = dqn(), observations(64, 0)
    sample = TensorDict({"observation": seen}, [64])
    box = bounds(seen, ObservationThreat().radius(seen, WORLD.facts.features))
    proven = []
    for weight in (0.0, 0.5):
        hooks = Lessons(Distillation(bounds=weight, temperature=0), teacher, WORLD.facts.features, seed=0)
        hooks.replayed(seen, teacher, 1.0)
        adam = torch.optim.Adam(hooks.start.parameters(), 3e-3)
        for _ in range(100):
            adam.zero_grad()
            hooks.loss(hooks.start, sample, lambda sample: torch.zeros(len(sample))).mean().backward()
            adam.step()
        possible = BoundedNetwork(hooks.start).possible(hooks.start.scores(seen).detach(), *box)[0]
        proven.append(float((possible.sum(-1) == 1).float().mean()))
    assert proven[0] < 0.5 * proven[1]


def test_the_student_begins_fresh_and_the_same_each_time() -> None:
    torch.manual_seed(5)
    teacher, drawn = QPolicy(5, 5, 8), torch.random.get_rng_state()
    starts = [Lessons(Distillation(), teacher, WORLD.facts.features, seed).start.state_dict() for seed in (5, 5, 6)]
    assert torch.equal(torch.random.get_rng_state(), drawn)
    first, again, other = (one["network.head.0.weight"] for one in starts)
    assert torch.equal(first, again)
    for different in (other, teacher.network.head[0].weight):
        assert not torch.equal(first, different)


def test_probabilities_hide_the_gradients_that_logits_show() -> None:
    victim, seen = choose("victim", "dqn").component, observations(64, 0)
    logits, hidden = (
        Distillation(answers=answers).load(victim, 0, WORLD.facts)  # type: ignore[arg-type]
        for answers in ("logits", "probabilities")
    )
    assert isinstance(hidden, Probabilities)
    assert torch.equal(hidden.decide(seen), logits.decide(seen))
    torch.testing.assert_close(hidden.scores(seen).sum(-1), torch.ones(64))
    assert shown(logits, seen)[1] < 0.01 < 0.1 < shown(hidden, seen)[1]


def test_large_logits_do_not_stop_pgd() -> None:
    policy = Distillation().load(choose("victim", "dqn").component, 0, WORLD.facts)
    seen = observations(32, 0)
    found, zero = shown(Times(policy, 1024.0), seen)
    assert zero < 0.01
    assert torch.equal(policy.decide(found), policy.decide(shown(policy, seen)[0]))


@pytest.mark.parametrize("victim", [DQN(**REPLAYED), PPO(**SHORT, fine_rollout=16)], ids=["dqn", "ppo"])
def test_it_trains_saves_loads_and_differs_from_its_controls(
    victim: LearningDriver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    monkeypatch.setattr(type(victim), "selection_episodes", 3)
    trained = victim.train(WORLD, seed=0, progress=silent)
    zoo.save(trained.network, zoo.Recipe.of(victim), seed=0, world=WORLD, card=trained.card)
    found = []
    for settings in ({}, {"temperature": 0.0}, {"bounds": 0.5}):
        defense = Distillation(**settings, decisions=160)
        ended = defense.train(victim, WORLD, seed=0, progress=silent)
        zoo.save(ended.network, zoo.Recipe.of(victim, defense), seed=0, world=WORLD, card=ended.card)
        scores = defense.load(victim, 0, WORLD.facts).scores(observations(8, 0))
        torch.testing.assert_close(scores, ended.network.scores(observations(8, 0)))
        found.append(scores)
    assert not any(torch.equal(found[0], other) for other in found[1:])


@pytest.mark.parametrize(
    ("defense", "victim", "line"),
    [
        (Distillation(), DDPG(), "discrete actions"),
        (Distillation(), SAC(), "dqn or ppo"),
        (Distillation(answers="probabilities"), DQN(), "does not change the training"),
    ],
    ids=["ddpg", "sac", "answers"],
)
def test_what_cannot_be_trained_is_refused(defense: Distillation, victim: DrivingVictim, line: str) -> None:
    with pytest.raises(UserError, match=line):
        defense.train(victim, WORLD, seed=0, progress=silent)


def test_what_has_no_training_has_nothing_to_load() -> None:
    with pytest.raises(UserError, match="distill needs a victim that learns"):
        Distillation().load(choose("victim", "idm").component, 0, WORLD.facts)
