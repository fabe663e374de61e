"""Short real trainings: their data, the attack in the loop, and reproducibility by seed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench import zoo
from cavbench.core import registry
from cavbench.defenses.driving.advtrain import AdversarialTraining, AttackInLoop
from cavbench.driving import DrivingWorld, Policy, State, TrainingHooks
from cavbench.driving.victims.attack_mix import AttackMix
from cavbench.driving.victims.behind import Guard, GuardedPractice, defense_of
from cavbench.driving.victims.ddpg import DDPG
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.learner import CHUNK
from cavbench.driving.victims.logits import SoftPolicy
from cavbench.driving.victims.networks import ActorPolicy, QPolicy
from cavbench.driving.victims.ppo import PPO
from cavbench.driving.victims.practice import ALLOWED, Practice, roads
from cavbench.driving.victims.sac import SAC
from cavbench.driving.victims.training import LearningDriver
from cavbench.errors import UserError

SHORT = {"decisions": 160, "copies": 1, "hidden": 8, "batch": 16, "checkpoints": 1}
REPLAYED = SHORT | {"memory": 2000}
VICTIMS = [DQN(**REPLAYED), DDPG(**REPLAYED)]
LEARNERS = [*VICTIMS, PPO(**SHORT, fine_rollout=16), SAC(**REPLAYED)]
NAMES = ["dqn", "ddpg", "ppo", "sac"]


def silent(share: float, text: str) -> None:
    """A progress callback that does nothing."""
    assert 0 <= share <= 1


@pytest.fixture
def world() -> DrivingWorld:
    return registry.load("world", "highway")()


@pytest.mark.parametrize("victim", LEARNERS, ids=NAMES)
def test_a_training_depends_on_its_seed_only(victim: LearningDriver, world: DrivingWorld) -> None:
    first, again, other = (victim.train(world, seed=seed, progress=silent).network.state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


def test_the_card_has_the_checkpoint_selection(world: DrivingWorld) -> None:
    card = VICTIMS[0].train(world, seed=0, progress=silent).card
    assert set(card["selection"]["safe_progress"]["clean"]) == {
        "mean",
        *(f"lanes {n}, density {d}, clear" for n in (3, 4, 5) for d in (1, 2)),
    }


def test_only_a_driver_that_learns_from_a_replay_buffer_has_its_parameters() -> None:
    of_the_buffer = {"n_step", "memory", "updates"}
    assert all(of_the_buffer <= {field.name for field in fields(victim)} for victim in (DQN, DDPG, SAC))
    assert not of_the_buffer & {field.name for field in fields(PPO)}


def test_returns_end_where_the_episode_ends(world: DrivingWorld) -> None:
    victim = DQN(**REPLAYED | {"copies": 4, "crash_penalty": 1000.0})
    phase = victim.phases(TrainingHooks())[0]
    env = world.make(roads(world, 4), action_type="discrete", action_repeat=phase.repeat)
    env.set_seed(0)
    learner = victim.learner(env, TrainingHooks())
    learner.enter(phase)
    practice = Practice(env, learner, phase, crash_penalty=1000.0)
    practice.drive(120, 0.0)
    seen = learner.buffer[:]
    short = seen["steps_to_next_obs"].squeeze(-1) < phase.n_step
    over = seen["next", "done"].squeeze(-1)
    crashed = seen["next", "terminated"].squeeze(-1)
    assert crashed.any()
    assert bool((over | ~short).all())
    assert bool((seen["next", "reward"].squeeze(-1)[crashed] < -1).all())
    assert bool((seen["next", "reward"].squeeze(-1)[~crashed] >= 0).all())


def test_in_the_second_phase_of_ppo_the_critic_learns_first_and_a_crash_costs_more(world: DrivingWorld) -> None:
    victim = PPO(**SHORT, fine_rollout=CHUNK, fine_batch=16, settling=2, tau=1.0)
    phase = victim.phases(TrainingHooks())[1]
    env = world.make(roads(world, 1), action_type="discrete")
    env.set_seed(0)
    learner = victim.learner(env, TrainingHooks())
    learner.enter(phase)
    assert learner.progress(TensorDict({"progress": 1.0, "crashed": True, "offroad": False})) == 1 - 360
    practice = Practice(env, learner, phase, crash_penalty=40.0)
    moved = []
    for _ in range(3):
        before = [[weight.clone() for weight in part.parameters()] for part in (learner.policy, learner.critic)]
        practice.drive(CHUNK, 0.5)
        learner.learn(1e-3, 0.5)
        after = [list(part.parameters()) for part in (learner.policy, learner.critic)]
        moved.append(
            [any((a != b).any() for a, b in zip(*pair, strict=True)) for pair in zip(before, after, strict=True)]
        )
    assert moved == [[False, True], [False, True], [True, True]]


@pytest.mark.parametrize("skip", [0.0, 0.5, 1.0])
def test_the_skip_probability_sets_the_rate_of_attacks(skip: float, world: DrivingWorld) -> None:
    defense = AdversarialTraining(
        start="scratch", where="acting", skip=skip, ramp_to=0.0, attack="noise", attack_params=""
    )
    card = defense.train(VICTIMS[0], world, seed=0, progress=silent).card
    assert card["attacked_decisions"] / (160 * 6) == pytest.approx(1 - skip, abs=0.06)


def test_the_budget_follows_the_ramp() -> None:
    defense = AdversarialTraining(skip=0.0, attack="noise", attack_params="", ramp_from=0.2, ramp_to=0.6)
    world = registry.load("world", "highway")()
    loop = AttackInLoop(defense, [registry.load("attack", "noise")()], world.facts, None, seed=0)
    policy, seen = QPolicy(5, 5, 8), 0.5 * torch.ones(16, 10, 5)
    moved = [float((loop.shown(seen, policy, share) - seen).abs().max()) for share in (0.1, 0.3, 0.4, 0.6, 0.9)]
    assert moved == pytest.approx([0.0, moved[4] / 4, moved[4] / 2, moved[4], moved[4]], rel=0.01)
    assert moved[4] > 0


def test_each_attack_of_the_loop_is_drawn_and_selects(world: DrivingWorld) -> None:
    defense = AdversarialTraining(skip=0.0, ramp_to=0.0)
    attacks = [registry.load("attack", "noise")(scale=scale) for scale in (0.01, 1.0)]
    loop = AttackInLoop(defense, attacks, world.facts, None, seed=0)
    policy, seen = QPolicy(5, 5, 8), 0.5 * torch.ones(2, 10, 5)
    strong = [bool((loop.shown(seen, policy, 0.5) - seen).abs().max() > 0.02) for _ in range(40)]
    assert 10 < sum(strong) < 30
    scored = {name: float((show(seen, None) - seen).abs().max()) for name, show in loop.selection(policy).items()}
    assert [moved > 0.02 for moved in scored.values()] == [False, True]
    assert loop.ranked({"clean": 0.8, **dict(zip(scored, (0.6, 0.2), strict=True))}) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("others", "wrong"),
    [("zo, nothing", "'nothing'"), ("zo, plan", "'plan' is not one"), ("zo steps", "'steps'")],
)
def test_an_attack_that_cannot_be_in_the_loop_is_refused(others: str, wrong: str, world: DrivingWorld) -> None:
    with pytest.raises(UserError, match=wrong):
        AdversarialTraining(others=others).train(VICTIMS[0], world, seed=0, progress=silent)


class Calm(TrainingHooks):
    """Another defence: it prefers small scores, scales replayed observations, and logs its calls."""

    def __init__(self) -> None:
        self.asked: set[str] = set()

    def replayed(self, observation: Tensor, policy: Policy, share: float) -> Tensor:
        self.asked.add("replayed")
        return 0.9 * observation

    def loss(self, policy: Policy, sample: TensorDictBase, own: Callable[[TensorDictBase], Tensor]) -> Tensor:
        torch.testing.assert_close(sample["observation"], 0.9 * sample["truth"])
        return own(sample) + 100 * policy.scores(sample["truth"]).square().mean()

    def selection(self, policy: Policy) -> dict[str, Callable[[Tensor, State], Tensor]]:
        return {"darker": lambda observation, state: 0.9 * observation}


@pytest.mark.parametrize("victim", VICTIMS, ids=["dqn", "ddpg"])
def test_any_defence_adds_its_own_loss_through_the_hooks(victim: LearningDriver, world: DrivingWorld) -> None:
    hooks, x = Calm(), torch.rand(64, 10, 5)
    plain = victim.train(world, seed=0, progress=silent).network.scores(x)
    calm = victim.train(world, seed=0, hooks=hooks, progress=silent)
    assert hooks.asked == {"replayed"}
    assert set(calm.card["selection"]["safe_progress"]) == {"clean", "darker"}
    assert float(calm.network.scores(x).square().mean()) < float(plain.square().mean())


@pytest.mark.parametrize("victim", VICTIMS, ids=["dqn", "ddpg"])
def test_default_hooks_do_not_change_the_training(victim: LearningDriver, world: DrivingWorld) -> None:
    plain, hooked = (
        victim.train(world, seed=0, hooks=hooks, progress=silent).network.state_dict()
        for hooks in (None, TrainingHooks())
    )
    assert all(torch.equal(plain[name], hooked[name]) for name in plain)


class Lesson:
    """A teacher, transitions with perturbed observations, and a learner that continues from the teacher."""

    def __init__(self, victim: LearningDriver, world: DrivingWorld) -> None:
        torch.manual_seed(0)
        discrete = victim.action_type == "discrete"
        shape = {"features": 5, "hidden": 8}
        self.victim, self.env = victim, world.make(roads(world, 1), action_type=victim.action_type)
        self.teacher = QPolicy(actions=5, **shape) if discrete else ActorPolicy(steering_limit=0.1, **shape)
        self.truth = torch.rand(64, 10, 5)
        self.shown = (self.truth + 0.3 * torch.randn(self.truth.shape)).clamp(-1, 1)
        action = torch.randint(5, (64,)) if discrete else torch.rand(64, 2) - 0.5
        after = {"observation": self.truth, "reward": torch.zeros(64, 1), "done": torch.zeros(64, 1, dtype=torch.bool)}
        after["terminated"] = after["done"].clone()
        self.sample = TensorDict(
            {"observation": self.shown, "truth": self.truth, "action": action, "next": after}, [64]
        )

    def decided(self, **params: float) -> torch.Tensor:
        """The learner's decisions on the perturbed observations after 150 updates: softmax probabilities, or the action."""
        defense = AdversarialTraining(**{"consistency": 0.0, "margin": 0.0, **params})
        facts = registry.load("world", "highway")().facts
        hooks = AttackInLoop(defense, [registry.load("attack", "none")()], facts, self.teacher, seed=0)
        learner = self.victim.learner(self.env, hooks)
        learner.enter(self.victim.phases(hooks)[0])
        for _ in range(150):
            learner.update(self.sample.clone(), 3e-3)
        learner.anneal()
        trained = learner.policy if self.victim.action_type == "discrete" else learner.averaged()
        return self.decision(trained.scores(self.shown).detach())

    def decision(self, scores: torch.Tensor) -> torch.Tensor:
        """Softmax probabilities of scores, on the teacher's scale; continuous actions are returned unchanged."""
        if self.victim.action_type == "continuous":
            return scores
        return torch.softmax(scores / (0.5 * self.teacher.scores(self.truth).std(-1, keepdim=True)), -1).detach()


@pytest.mark.parametrize("victim", VICTIMS, ids=["dqn", "ddpg"])
def test_consistency_moves_decisions_under_attack_towards_clean_decisions(
    victim: LearningDriver, world: DrivingWorld
) -> None:
    lesson = Lesson(victim, world)
    wanted = lesson.decision(lesson.teacher.scores(lesson.truth))
    far, near = ((lesson.decided(consistency=weight) - wanted).square().mean() for weight in (0.0, 10.0))
    assert float(near) < 0.7 * float(far)


def test_a_margin_makes_lane_changes_less_likely(world: DrivingWorld) -> None:
    lesson = Lesson(VICTIMS[0], world)
    spread = float(lesson.teacher.scores(lesson.truth).std(-1).mean())
    without, reluctant = (lesson.decided(consistency=10.0, margin=margin).mean(0) for margin in (0.0, spread))
    assert bool((reluctant[[0, 2]] < 0.7 * without[[0, 2]]).all())


@pytest.mark.parametrize("victim", LEARNERS, ids=NAMES)
@pytest.mark.parametrize("start", ["trained", "scratch"])
def test_adversarial_training_trains_saves_and_loads(
    victim: LearningDriver, start: str, world: DrivingWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    trained = victim.train(world, seed=0, progress=silent)
    zoo.save(trained.network, zoo.Recipe.of(victim), seed=0, world=world, card=trained.card)
    defense = AdversarialTraining(start=start, decisions=160, attack="zo", attack_params="steps=1 directions=2")
    hardened = defense.train(victim, world, seed=0, progress=silent)
    assert hardened.card["attacked_decisions"] > 0
    zoo.save(hardened.network, zoo.Recipe.of(victim, defense), seed=0, world=world, card=hardened.card)
    loaded = defense.load(victim, 0, world.facts)
    x = torch.rand(4, 10, 5)
    torch.testing.assert_close(loaded.scores(x), hardened.network.scores(x))
    assert not torch.equal(loaded.scores(x), victim.load(0, world.facts).scores(x))


@pytest.mark.parametrize("victim", [*LEARNERS], ids=NAMES)
def test_a_policy_behind_a_filter_learns_from_what_passes_it(victim: LearningDriver, world: DrivingWorld) -> None:
    """Stored actions are allowed (or clipped when they are carried out), and a new episode begins with a fresh state."""
    recipe = replace(victim, behind="tracker+shield")
    policy = recipe.policy_type(**_shape(recipe))
    hooks = AttackMix(policy, 40, world.facts, seed=0)
    env = world.make(roads(world, 4), action_type=recipe.action_type)
    env.set_seed(0)
    learner = recipe.learner(env, hooks)
    phase = recipe.phases(hooks)[0]
    learner.enter(phase)
    guard = Guard(defense_of(recipe.behind), recipe, world.facts)
    practice = GuardedPractice(env, learner, phase, crash_penalty=40.0, guard=guard)
    executed = []
    for _ in range(40):
        before = practice.seen
        with torch.no_grad():
            step = practice.decide(0.0)
        assert torch.equal(step["observation"], before["observation"])
        action, allowed = step["action"], step[ALLOWED]
        if recipe.action_type == "discrete":
            assert bool(allowed.gather(1, action.unsqueeze(1)).all())
        else:
            executed.append((action.clamp(allowed[:, 0], allowed[:, 1]) - action).abs().max())
        restarted = step["next", "done"].squeeze(-1)
        assert practice.state is not None
        assert torch.equal(practice.state["ego", "known"], ~restarted)
    assert recipe.action_type == "discrete" or max(executed) > 0.1


def soft_lesson(**params: object) -> tuple[SAC, Lesson]:
    """A SAC and transitions [64] of single decisions: `action` 2 earns 1, the others 0."""
    victim = SAC(**REPLAYED | params)
    lesson = Lesson(victim, registry.load("world", "highway")())
    sample = lesson.sample
    sample["next", "reward"] = (sample["action"] == 2).float().unsqueeze(-1)
    sample["next", "terminated"] = sample["next", "done"] = torch.ones(64, 1, dtype=torch.bool)
    return victim, lesson


@pytest.mark.parametrize("target", [0.9, 0.2])
def test_the_temperature_keeps_the_target_entropy(target: float) -> None:
    victim, lesson = soft_lesson(final_entropy=target, entropy=target, temperature=1.0, temperature_rate=0.02)
    learner = victim.learner(lesson.env, TrainingHooks())
    learner.enter(victim.phases(TrainingHooks())[0])
    for _ in range(400):
        learner.update(lesson.sample.clone(), 3e-3)
    policy = torch.distributions.Categorical(logits=learner.policy.scores(lesson.shown))
    assert float(policy.entropy().mean()) / math.log(5) == pytest.approx(target, abs=0.1)
    assert bool((policy.probs.argmax(-1) == 2).all())


def test_the_target_entropy_falls_to_its_end() -> None:
    victim, lesson = soft_lesson(entropy=0.8, final_entropy=0.1, explore_until=0.5)
    learner = victim.learner(lesson.env, TrainingHooks())
    learner.enter(victim.phases(TrainingHooks())[0])
    shares = []
    for _ in range(victim.decisions // CHUNK):
        learner.anneal()
        shares.append(float(learner.loss.target_entropy) / math.log(5))
    assert shares[4] == pytest.approx(0.8 * (0.1 / 0.8) ** 0.5, rel=1e-4)
    assert shares[9:] == pytest.approx([0.1] * 11, rel=1e-4)


def test_actions_that_are_not_allowed_have_no_part_in_the_soft_values() -> None:
    """The value of the next state is that of the only action that is left."""
    victim, lesson = soft_lesson(behind="tracker+shield", temperature=1.0)
    learner = victim.learner(lesson.env, TrainingHooks())
    learner.enter(victim.phases(TrainingHooks())[0])
    sample, only = lesson.sample.clone(), torch.nn.functional.one_hot(torch.arange(64) % 5, 5).bool()
    sample["next", "terminated"] = sample["next", "done"] = torch.zeros(64, 1, dtype=torch.bool)
    sample["next", ALLOWED] = only
    target = learner.loss._compute_target(sample)
    values = learner.policy.values(sample["next", "observation"])[only]
    torch.testing.assert_close(target, sample["next", "reward"].squeeze(-1) + victim.gamma * values)


def test_a_soft_policy_continues_with_its_critics(world: DrivingWorld) -> None:
    start = SoftPolicy(5, 5, 8)
    hooks = AttackMix(start, 40, world.facts, seed=0)
    learner = SAC(**REPLAYED).learner(world.make(roads(world, 1), action_type="discrete"), hooks)
    learner.anneal()
    for network in (learner.policy, learner.averaged()):
        assert all(torch.equal(value, start.state_dict()[name]) for name, value in network.state_dict().items())


def test_another_defence_is_part_of_the_recipe() -> None:
    plain, behind, other = DQN(), DQN(behind="shield"), DQN(behind="shield band=6")
    keys = {zoo.Recipe.of(victim).key for victim in (plain, behind, other)}
    assert len(keys) == 3
    assert behind.zoo_name() == "dqn-behind-shield"


def _shape(victim: LearningDriver) -> dict[str, object]:
    shape: dict[str, object] = {"features": 5, "hidden": 8}
    return shape | ({"actions": 5} if victim.action_type == "discrete" else {"steering_limit": 0.1})
