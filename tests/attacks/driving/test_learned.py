"""Attacks with a network of their own: what they induce, how they are trained, and how the zoo keeps them."""

from __future__ import annotations

import importlib.util
import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench import zoo
from cavbench.attacks.driving.director_training import AdversaryWorld, Victim
from cavbench.attacks.driving.objectives import margin
from cavbench.attacks.driving.paad import PAAD
from cavbench.attacks.driving.pgd import PGD
from cavbench.attacks.driving.sarsa import RobustSarsa, Value
from cavbench.attacks.driving.targets import Controls, EveryAction
from cavbench.attacks.driving.two_stage import TwoStage
from cavbench.checks.check import Subject
from cavbench.core.contracts import Trained
from cavbench.core.pair import Pair, choose
from cavbench.defenses.driving.advtrain import AdversarialTraining
from cavbench.defenses.none import NoDefense
from cavbench.driving import DrivingAttack, DrivingWorld, ObservationThreat, Policy
from cavbench.driving.access import Enforcer
from cavbench.driving.checks.attack import AttackSuite
from cavbench.driving.victim import CountedPolicy
from cavbench.driving.victims.ddpg import DDPG
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.networks import QPolicy
from cavbench.driving.victims.practice import roads
from cavbench.errors import UserError
from cavbench.run.unit import Unit
from cavbench.scenarios import SeedBlock
from tests.attacks.driving.victims import observations, perturb, victim
from tests.tree import ROOT

SHORT = {"decisions": 8, "hidden": 8}
LEARNED = [TwoStage(**SHORT), PAAD(**SHORT, training_steps=1), RobustSarsa(decisions=48, hidden=8, updates=1)]
NAMES = [type(attack).__name__ for attack in LEARNED]


def silent(share: float, text: str) -> None:
    """A progress callback that does nothing."""


@pytest.fixture
def world() -> DrivingWorld:
    return choose("world", "highway").component


@pytest.fixture(autouse=True)
def own_zoo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    return tmp_path / "zoo"


class Preferring(Policy):
    """A director with the same values in every state."""

    action_type = "discrete"

    def __init__(self, *values: float) -> None:
        super().__init__()
        self.values = torch.tensor(values)

    def forward(self, observation: Tensor) -> Tensor:
        return self.values.expand(*observation.shape[:-2], -1)


def trained(attack: DrivingAttack, world: DrivingWorld, seed: int = 0) -> Trained[Policy]:
    """A short training against the shipped `dqn`."""
    return attack.train(DQN(), NoDefense(), world, seed=seed, progress=silent)


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


def test_paad_follows_the_victims_own_ranking_where_its_director_prefers_that() -> None:
    policy, seen = victim("discrete", 1), observations(40, 1)
    own = PAAD(steps=10, restarts=1).armed(Preferring(0, 0, 0, 0, 0, 1))
    lost, by_pgd, untouched = (
        policy.scores(seen).gather(-1, policy.decide(shown)[:, None]).mean()
        for shown in (perturb(own, policy, seen)[0], perturb(PGD(), policy, seen)[0], seen)
    )
    assert lost < untouched
    assert lost == pytest.approx(float(by_pgd), abs=0.1 * float(untouched - by_pgd))


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


def test_every_target_is_reached_by_its_own_action() -> None:
    controls, numbers = Controls(0.1), torch.arange(9)
    actions = controls.action(numbers)
    assert actions.abs().amax(0).tolist() == pytest.approx([1.0, 0.1])
    assert torch.equal(controls.loss(actions, numbers), torch.zeros(9))
    scores = torch.eye(5)
    assert bool((controls.loss(actions, numbers.roll(1)) > 0.9).all())
    assert bool((margin(scores, torch.arange(5)) == -EveryAction(5).loss(scores, torch.arange(5))).all())


def test_the_critic_alone_decides_what_sarsa_induces() -> None:
    """For a critic with one bad action, it induces that action about as often as PGD towards it."""
    policy, seen = victim("discrete", 3), observations(40, 3)
    clean, by_sarsa, by_pgd = 0.0, 0.0, 0.0
    for bad in range(5):
        critic = Value(5, 5, 4, 0.1)
        with torch.no_grad():
            for weight in critic.parameters():
                weight.zero_()
            critic.network.head[-1].bias[1 + bad] = -1.0
        shown = [
            seen,
            perturb(RobustSarsa().armed(critic), policy, seen)[0],
            perturb(PGD(objective="target", target_action=bad), policy, seen)[0],
        ]
        taken = [float((policy.decide(each) == bad).float().mean()) for each in shown]
        clean, by_sarsa, by_pgd = clean + taken[0], by_sarsa + taken[1], by_pgd + taken[2]
    assert clean == pytest.approx(1.0)
    assert by_pgd > 1.2
    assert by_sarsa - clean >= 0.7 * (by_pgd - clean)


@pytest.mark.parametrize("attack", LEARNED, ids=NAMES)
def test_a_training_depends_on_its_seed_only_and_leaves_the_victim_alone(
    attack: DrivingAttack, world: DrivingWorld
) -> None:
    before = DQN().load(0, world.facts).state_dict()
    first, again, other = (trained(attack, world, seed).network.state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)
    after = DQN().load(0, world.facts).state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_the_card_says_what_was_attacked_and_what_was_left_of_it(world: DrivingWorld) -> None:
    card = trained(LEARNED[1], world).card
    assert card["against"] == DQN().load(0, world.facts).weights_sha256
    assert 0 <= card["selection"]["safe_progress"]["clean"]["mean"] <= 1


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


@pytest.mark.parametrize("attack", LEARNED, ids=NAMES)
def test_the_zoo_keeps_an_adversary_and_says_how_to_train_a_missing_one(
    attack: DrivingAttack, world: DrivingWorld, own_zoo: Path
) -> None:
    recipe = zoo.Recipe.of(DQN(), NoDefense(), attack)
    with pytest.raises(UserError, match=r"`bench train victim=dqn attack=.* seeds=0`"):
        attack.load(DQN(), NoDefense(), 0, world.facts)
    made = trained(attack, world)
    zoo.save(made.network, recipe, seed=0, world=world, card=made.card)
    loaded = attack.load(DQN(), NoDefense(), 0, world.facts)
    weights = made.network.state_dict()
    assert all(torch.equal(weights[name], value) for name, value in loaded.state_dict().items())
    assert not loaded.training
    assert not any(weight.requires_grad for weight in loaded.parameters())
    seen = observations(6, rows=10)
    policy = DQN().load(0, world.facts)
    assert torch.equal(
        perturb(attack.armed(loaded), policy, seen)[0], perturb(attack.armed(made.network), policy, seen)[0]
    )


def test_an_adversary_of_other_weights_is_refused(world: DrivingWorld, own_zoo: Path) -> None:
    attack = LEARNED[1]
    made = trained(attack, world)
    recipe = zoo.Recipe.of(DQN(), NoDefense(), attack)
    zoo.save(made.network, recipe, seed=0, world=world, card={**made.card, "against": "0" * 64})
    with pytest.raises(UserError, match="was trained against a victim with weights 000000000000…, and the victim has"):
        attack.load(DQN(), NoDefense(), 0, world.facts)


def test_a_recipe_names_the_attack_the_victim_and_the_defence_with_their_parameters() -> None:
    base = zoo.Recipe.of(DQN(), NoDefense(), PAAD())
    assert base.name == "paad-dqn"
    assert base.train(3) == "bench train victim=dqn attack=paad seeds=3"
    others = [
        zoo.Recipe.of(DQN(hidden=64), NoDefense(), PAAD()),
        zoo.Recipe.of(DQN(), AdversarialTraining(), PAAD()),
        zoo.Recipe.of(DQN(), AdversarialTraining(skip=0.5), PAAD()),
        zoo.Recipe.of(DQN(), NoDefense(), PAAD(budget=0.2)),
        zoo.Recipe.of(DQN(), NoDefense(), RobustSarsa()),
    ]
    assert len({base.digest, *(other.digest for other in others)}) == 6
    assert others[2].train(0) == "bench train victim=dqn defense=advtrain attack=paad defense.skip=0.5 seeds=0"


def test_parameters_of_the_run_need_no_other_training() -> None:
    base = zoo.Recipe.of(DQN(), NoDefense(), PAAD())
    assert zoo.Recipe.of(DQN(), NoDefense(), PAAD(steps=30, restarts=1)).digest == base.digest


def test_the_driver_of_two_stage_is_shared_by_all_victims_with_the_same_actions() -> None:
    first = zoo.Recipe.of(DQN(), NoDefense(), TwoStage())
    second = zoo.Recipe.of(DQN(hidden=64), AdversarialTraining(), TwoStage())
    assert first.key == second.key
    assert second.train(0) == "bench train victim=dqn defense=advtrain attack=two_stage victim.hidden=64 seeds=0"
    assert zoo.Recipe.of(DDPG(), NoDefense(), TwoStage()).key != first.key


def test_another_adversary_is_another_unit_of_work(world: DrivingWorld) -> None:
    parts = {
        "attack": choose("attack", "paad"),
        "defense": choose("defense", "none"),
        "victim": choose("victim", "dqn"),
    }
    pair = Pair(**parts, world=choose("world", "highway"), threat=ObservationThreat())
    cell = world.axes.cell(lanes=3, density=1.0, weather="clear")
    unit = Unit(pair=pair, cell=cell, training_seed=0, seeds=range(2), weights_sha256="w", adversary_sha256="a")
    assert unit.fingerprint != replace(unit, adversary_sha256="b").fingerprint
    assert pair.is_seeded


def test_adversarial_training_refuses_an_attack_that_learns(world: DrivingWorld) -> None:
    with pytest.raises(UserError, match="takes attacks that do not learn"):
        AdversarialTraining(attack="paad", attack_params="").train(DQN(), world, seed=0, progress=silent)


def test_directed_attacks_keep_to_small_query_budgets() -> None:
    policy, seen = victim("discrete"), observations(8)
    director = QPolicy(5, 6, 8).requires_grad_(False)
    for queries in (0, 1, 2, 3, 9, 40):
        threat = ObservationThreat(queries=queries)
        shown, spent = perturb(PAAD().armed(director), policy, seen, threat)
        assert int(spent.max()) <= queries
        features = choose("world", "highway").component.features
        enforcer = Enforcer(CountedPolicy(policy), threat, "oblivious", features, torch.Generator())
        torch.testing.assert_close(enforcer.begin(seen).project(shown), shown)


def test_the_attack_that_learns_on_the_page_of_plug_ins_works(world: DrivingWorld, tmp_path: Path) -> None:
    page = (ROOT / "docs" / "plugins.md").read_text()
    (code,) = re.findall(r"```python\n(\"\"\"Universal:.*?)```", page, re.DOTALL)
    (tmp_path / "universal.py").write_text(code)
    spec = importlib.util.spec_from_file_location("universal", tmp_path / "universal.py")
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["universal"] = module
    try:
        spec.loader.exec_module(module)
        attack = module.Universal(candidates=20)
        made = trained(attack, world)
        recipe = zoo.Recipe.of(DQN(), NoDefense(), attack)
        zoo.save(made.network, recipe, seed=0, world=world, card=made.card)
        armed = attack.armed(attack.load(DQN(), NoDefense(), 0, world.facts))
        subject = Subject(kind="attack", name="universal", component=armed, world=world, victim=DQN())
        assert [one for one in AttackSuite(subject).outcomes() if one.status != "pass"] == []
    finally:
        del sys.modules["universal"]
