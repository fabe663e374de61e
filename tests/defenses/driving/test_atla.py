"""The policy with a memory, the learned adversary, and their training in turns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench import zoo
from cavbench.attacks.driving.pgd import PGD
from cavbench.attacks.driving.rehearse import Rehearse
from cavbench.attacks.driving.zo import ZOSignSGD
from cavbench.core.pair import choose
from cavbench.defenses.driving.adversary import Adversary
from cavbench.defenses.driving.alternating import Alternation, RecurrentPractice, Turn
from cavbench.defenses.driving.atla import AlternatingTraining, Scored
from cavbench.defenses.driving.recurrent import RecurrentPolicy
from cavbench.driving import DrivingAttack, ObservationThreat
from cavbench.driving.rollout import rollout
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.learner import CHUNK, Phase
from cavbench.driving.victims.networks import QPolicy
from cavbench.driving.victims.practice import roads
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from tests.attacks.driving.victims import FEATURES, observations, victim
from tests.driving.policies import recurrent

WORLD = HighwayWorld()
TINY: dict[str, Any] = {
    "alternations": 1,
    "decisions": 16,
    "adversary_decisions": 16,
    "rollout": 8,
    "parts": 2,
    "memory": 4,
    "adversary_hidden": 8,
    "temperature": 1.0,
    "adversary_rate": 0.05,
}


def silent(share: float, text: str) -> None:
    """A progress callback that does nothing."""


def start() -> QPolicy:
    policy = victim("discrete")
    assert isinstance(policy, QPolicy)
    return policy


def adversary(scale: float = 1.0, seed: int = 0) -> Adversary:
    torch.manual_seed(seed)
    made = Adversary(5, 8, ObservationThreat(), FEATURES)
    made.scale = scale
    return made


def test_it_continues_with_the_decisions_of_its_start() -> None:
    policy = RecurrentPolicy.continuing(start(), 8, temperature=0.1)
    state = policy.initial(torch.arange(6))
    for step in range(3):
        seen = observations(6, step)
        values = start().scores(seen)
        logits = policy.scores(seen, state)
        wanted = (values - values.mean(-1, keepdim=True)) / 0.1
        torch.testing.assert_close(logits - logits.mean(-1, keepdim=True), wanted, rtol=1e-4, atol=1e-4)
        state = policy.advance(seen, policy.decide(seen, state), state)
    assert state is not None
    assert bool(state["memory"].any())


def test_a_sequence_gives_what_its_steps_give_and_a_new_episode_forgets() -> None:
    policy, steps = recurrent(), 5
    seen = torch.stack([observations(6, step) for step in range(steps)], 1)
    first = torch.zeros(6, steps, dtype=torch.bool)
    first[:3, 2] = True
    logits, memories = policy.network.unrolled(seen, torch.zeros(6, 8), first)
    state = policy.initial(torch.arange(6))
    for step in range(steps):
        assert state is not None
        state["memory"][first[:, step]] = 0
        torch.testing.assert_close(policy.scores(seen[:, step], state), logits[:, step])
        state = policy.advance(seen[:, step], torch.zeros(6), state)
        assert state is not None
        torch.testing.assert_close(state["memory"], memories[:, step])


def test_the_past_matters() -> None:
    policy, seen = recurrent(), observations(6, 0)
    fresh = policy.initial(torch.arange(6))
    later = policy.advance(observations(6, 1), torch.zeros(6), fresh)
    assert not torch.allclose(policy.scores(seen, fresh), policy.scores(seen, later))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), scale=st.floats(0, 1), norm=st.sampled_from(["relative", "linf"]))
def test_the_adversary_stays_in_the_set(seed: int, scale: float, norm: Any) -> None:
    made = adversary(scale, seed)
    made.threat = ObservationThreat(norm=norm, budget=0.2)
    truth = observations(4, seed)
    shown = made.shown(truth)
    assert bool(((shown - truth).abs() <= made.threat.radius(truth, FEATURES, scale) + 1e-6).all())
    assert torch.equal(shown[..., 0], truth[..., 0])
    assert bool((shown.abs() <= 1).all())


def test_the_order_of_the_cars_does_not_matter_to_the_adversary() -> None:
    made, truth = adversary(), observations(4, 0, rows=5)
    order = torch.tensor([0, 3, 1, 4, 2])
    torch.testing.assert_close(made.shown(truth[:, order]), made.shown(truth)[:, order])


def alternation(**changes: Any) -> tuple[Alternation, RecurrentPractice]:
    torch.manual_seed(0)
    recipe = AlternatingTraining(**{**TINY, **changes})
    policy = RecurrentPolicy.continuing(start(), recipe.memory, recipe.temperature)
    threat = ObservationThreat(budget=recipe.budget)
    made = Adversary(5, recipe.adversary_hidden, threat, WORLD.facts.features)
    made.scale = 1.0
    learner = Alternation(policy, made, start(), recipe.updates)
    env = WORLD.make(roads(WORLD, 1), action_type="discrete")
    env.set_seed(0)
    phase = Phase(1, 16, 0.99, 1)
    learner.enter(phase)
    return learner, RecurrentPractice(env, learner, phase, crash_penalty=40.0)


def weights(learner: Alternation) -> list[list[Tensor]]:
    return [
        [weight.detach().clone() for weight in network.parameters()] for network in (learner.policy, learner.adversary)
    ]


@pytest.mark.parametrize("turn", ["policy", "adversary"])
def test_only_the_player_whose_turn_it_is_learns(turn: Turn) -> None:
    learner, practice = alternation()
    before = weights(learner)
    learner.begin(turn)
    practice.drive(CHUNK, 0.5)
    learner.learn(1.0, 0.5)
    changed = [any(map(_differ, old, new)) for old, new in zip(before, weights(learner), strict=True)]
    assert changed == [turn == "policy", turn == "adversary"]


def _differ(old: Tensor, new: Tensor) -> bool:
    return not torch.equal(old, new)


def test_the_adversary_lowers_what_the_policy_expects() -> None:
    learner, practice = alternation(guide=10.0, budget=0.3)
    learner.begin("adversary")
    practice.drive(CHUNK, 0.0)
    played = torch.cat(learner.chunks, -1)
    truth = played["observation"]

    def expected() -> float:
        with torch.no_grad():
            chosen = learner.actor.get_dist(played.clone()).probs
        return float((chosen * learner._worth(truth)).sum(-1).mean())

    before = expected()
    for _ in range(5):
        learner.collect(played.clone())
        learner.learn(1.0, 0.0)
    assert expected() < before - 0.02


def test_checkpoints_with_a_smaller_budget_come_after_all_others() -> None:
    made = adversary(0.5)
    scored = Scored(made)
    early = scored.ranked({"clean": 0.9, "attacked": 0.9})
    made.scale = 1.0
    assert scored.ranked({"clean": 0.2, "attacked": 0.0}) > early
    assert scored.curve[0] == {"scale": 0.5, "clean": 0.9, "attacked": 0.9}


def test_it_trains_saves_and_loads_and_so_does_its_control(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    monkeypatch.setattr(DQN, "selection_episodes", 3)
    driver = DQN(copies=1, hidden=8)
    zoo.save(QPolicy(5, 5, 8), zoo.Recipe.of(driver), seed=0, world=WORLD, card={})
    begun = RecurrentPolicy.continuing(driver.load(0, WORLD.facts), TINY["memory"], TINY["temperature"])
    seen = observations(8, 0)
    for budget in (0.1, 0.0):
        defense = AlternatingTraining(**TINY, budget=budget)
        ended = defense.train(driver, WORLD, seed=0, progress=silent)
        zoo.save(ended.network, zoo.Recipe.of(driver, defense), seed=0, world=WORLD, card=ended.card)
        loaded = defense.load(driver, 0, WORLD.facts)
        state = loaded.initial(torch.arange(8))
        scores = loaded.scores(seen, state)
        torch.testing.assert_close(scores, ended.network.scores(seen, state))
        assert set(ended.card["selection"]["safe_progress"]) == ({"clean", "attacked"} if budget else {"clean"})
        assert [round(one["scale"], 2) for one in ended.card["selection_history"]] == [0, 1]
        assert not torch.allclose(scores, begun.scores(seen, state))


@pytest.mark.parametrize("name", ["ddpg", "ppo", "idm"])
def test_other_victims_are_refused(name: str) -> None:
    other = choose("victim", name).component
    with pytest.raises(UserError, match="atla continues from a dqn"):
        AlternatingTraining().load(other, 0, WORLD.facts)
    with pytest.raises(UserError, match="use victim=dqn"):
        AlternatingTraining().train(other, WORLD, seed=0, progress=silent)


ATTACKS = [PGD(steps=2, restarts=1), ZOSignSGD(steps=1, directions=2), Rehearse()]


@pytest.mark.parametrize("attack", ATTACKS, ids=["pgd", "zo", "rehearse"])
def test_the_shipped_policy_is_driven_under_attack(attack: DrivingAttack) -> None:
    world, seeds = HighwayWorld(max_steps=20), [1_000_000, 1_000_001]
    cells = [AXES.cell(lanes=4, density=1.0)] * len(seeds)
    policy = AlternatingTraining().load(DQN(), 0, world.facts)
    columns = rollout(
        world.make(cells),
        policy,
        attack,
        ObservationThreat(access="dynamics"),
        seeds,
        facts=world.facts,
        attack_seed=0,
        dynamics=world.dynamics(cells, "discrete"),
    )
    assert bool((columns["queries"] > 0).all())
    if attack.access == "gradients":
        assert bool((columns["zero_gradients"] == 0).all())


def test_a_driver_behind_a_defence_is_refused() -> None:
    with pytest.raises(UserError, match="atla trains no driver behind 'tracker'"):
        AlternatingTraining().load(DQN(behind="tracker"), 0, WORLD.facts)
