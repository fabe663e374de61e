"""Training, for real but short: what is learned from, what is attacked, and that a seed decides it all."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from bench.driving import DrivingWorld
from bench.driving.contracts import AttackInLoop
from bench.plugins import registry
from bench.victims import zoo
from bench.victims.drivers.ddpg import DDPG
from bench.victims.drivers.dqn import DQN
from bench.victims.drivers.networks import ActorPolicy, QPolicy
from bench.victims.drivers.training import LearningDriver, Practice, roads
from defenses.advtrain import AdversarialTraining

SHORT = {"decisions": 160, "copies": 1, "hidden": 8, "batch": 16, "memory": 2000, "checkpoints": 1}
VICTIMS = [DQN(**SHORT), DDPG(**SHORT)]


def silent(share: float, text: str) -> None:
    """A progress bar that nobody looks at."""
    assert 0 <= share <= 1


@pytest.fixture
def world() -> DrivingWorld:
    return registry.load("world", "highway")()


@pytest.mark.parametrize("victim", VICTIMS, ids=["dqn", "ddpg"])
def test_a_training_depends_on_its_seed_alone(victim: LearningDriver, world: DrivingWorld) -> None:
    first, again, other = (victim.train(world, seed=seed, progress=silent).network.state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


def test_the_card_says_what_was_trained_and_on_what_it_was_chosen(world: DrivingWorld) -> None:
    card = VICTIMS[0].train(world, seed=0, progress=silent).card
    assert card["victim"]["decisions"] == 160
    assert set(card["selection"]["safe_progress"]["clean"]) == {
        "mean",
        *(f"{n} lanes, density {d}" for n in (3, 4, 5) for d in (1, 2)),
    }


def test_returns_end_where_the_episode_ends(world: DrivingWorld) -> None:
    victim = DQN(**SHORT | {"copies": 4, "crash_penalty": 1000.0})
    phase = victim.phases(None)[0]
    env = world.make(roads(4), action_type="discrete", action_repeat=phase.repeat)
    env.set_seed(0)
    learner = victim.learner(env, None)
    learner.enter(phase)
    practice = Practice(env, learner, victim, phase, None, torch.Generator())
    practice.drive(120, 0.0)
    seen = practice.buffer[:]
    short = seen["steps_to_next_obs"].squeeze(-1) < phase.n_step
    over = seen["next", "done"].squeeze(-1)
    crashed = seen["next", "terminated"].squeeze(-1)
    assert crashed.any()
    assert bool((over | ~short).all())
    assert bool((seen["next", "reward"].squeeze(-1)[crashed] < -1).all())
    assert bool((seen["next", "reward"].squeeze(-1)[~crashed] >= 0).all())


@pytest.mark.parametrize("skip", [0.0, 0.5, 1.0])
def test_the_skip_probability_decides_how_often_the_attack_is_met(skip: float, world: DrivingWorld) -> None:
    def attack(observation: torch.Tensor, policy: torch.nn.Module, scale: float) -> torch.Tensor:
        return observation

    loop = AttackInLoop(attack=attack, skip=skip, where="acting", ramp=(0.0, 0.0))
    card = VICTIMS[0].train(world, seed=0, attack=loop, progress=silent).card
    assert card["attacked_decisions"] / (160 * 6) == pytest.approx(1 - skip, abs=0.06)


class Lesson:
    """A teacher, transitions shown otherwise than they were, and a learner that goes on from the teacher."""

    def __init__(self, victim: LearningDriver, world: DrivingWorld) -> None:
        torch.manual_seed(0)
        discrete = victim.action_type == "discrete"
        shape = {"features": 5, "hidden": 8}
        self.victim, self.env = victim, world.make(roads(1), action_type=victim.action_type)
        self.teacher = QPolicy(actions=5, **shape) if discrete else ActorPolicy(steering_limit=0.1, **shape)
        self.truth = torch.rand(64, 10, 5)
        self.shown = (self.truth + 0.3 * torch.randn(self.truth.shape)).clamp(-1, 1)
        action = torch.randint(5, (64,)) if discrete else torch.rand(64, 2) - 0.5
        after = {"observation": self.truth, "reward": torch.zeros(64, 1), "done": torch.zeros(64, 1, dtype=torch.bool)}
        after["terminated"] = after["done"].clone()
        self.sample = TensorDict(
            {"observation": self.shown, "truth": self.truth, "action": action, "next": after}, [64]
        )

    def decided(self, **loop: float) -> torch.Tensor:
        """What the learner decides on what is shown after 150 updates: softmax probabilities, or the action."""
        attack = AttackInLoop(attack=lambda o, p, s: o, skip=0.0, start=self.teacher, **loop)
        learner = self.victim.learner(self.env, attack)
        learner.enter(self.victim.phases(attack)[0])
        for _ in range(150):
            learner.update(self.sample.clone(), 3e-3)
        learner.anneal()
        trained = learner.policy if self.victim.action_type == "discrete" else learner.averaged()
        return self.decision(trained.scores(self.shown).detach())

    def decision(self, scores: torch.Tensor) -> torch.Tensor:
        """The probabilities that scores stand for, on the teacher's scale; an action is what it is."""
        if self.victim.action_type == "continuous":
            return scores
        return torch.softmax(scores / (0.5 * self.teacher.scores(self.truth).std(-1, keepdim=True)), -1).detach()


@pytest.mark.parametrize("victim", VICTIMS, ids=["dqn", "ddpg"])
def test_consistency_brings_decisions_under_attack_to_those_on_the_truth(
    victim: LearningDriver, world: DrivingWorld
) -> None:
    lesson = Lesson(victim, world)
    wanted = lesson.decision(lesson.teacher.scores(lesson.truth))
    far, near = ((lesson.decided(consistency=weight) - wanted).square().mean() for weight in (0.0, 10.0))
    assert float(near) < 0.7 * float(far)


def test_a_margin_makes_changes_of_lane_less_wanted(world: DrivingWorld) -> None:
    lesson = Lesson(VICTIMS[0], world)
    spread = float(lesson.teacher.scores(lesson.truth).std(-1).mean())
    without, reluctant = (lesson.decided(consistency=10.0, margin=margin).mean(0) for margin in (0.0, spread))
    assert bool((reluctant[[0, 2]] < 0.7 * without[[0, 2]]).all())


@pytest.mark.parametrize("victim", VICTIMS, ids=["dqn", "ddpg"])
@pytest.mark.parametrize("start", ["trained", "scratch"])
def test_adversarial_training_trains_saves_and_loads(
    victim: LearningDriver, start: str, world: DrivingWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    trained = victim.train(world, seed=0, progress=silent)
    zoo.save(trained.network, trained.card, name=victim.zoo_name(), seed=0)
    defense = AdversarialTraining(start=start, decisions=160, attack="zo", attack_params="steps=1 directions=2")
    hardened = defense.train(victim, world, seed=0, progress=silent)
    assert hardened.card["attacked_decisions"] > 0
    zoo.save(hardened.network, hardened.card, name=defense.zoo_name(victim), seed=0)
    loaded = defense.load(victim, 0)
    x = torch.rand(4, 10, 5)
    torch.testing.assert_close(loaded.scores(x), hardened.network.scores(x))
    assert not torch.equal(loaded.scores(x), victim.load(0).scores(x))
