"""The zoo: entries are found by recipe, load as they were saved, and can be trained again from their card."""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from safetensors.torch import save as save_tensors

from cavbench import zoo
from cavbench.core import registry
from cavbench.core.track import track
from cavbench.defenses.driving.advtrain import AdversarialTraining
from cavbench.detection import CameraWorld
from cavbench.detection.victims.yolov5 import YOLOv5, YOLOv5Network
from cavbench.driving import DrivingWorld
from cavbench.driving.victims.ddpg import DDPG
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.networks import QPolicy
from cavbench.errors import UserError
from cavbench.identity.fingerprint import sources
from cavbench.run.config import plan_of, training_of
from cavbench.zoo.store import SHIPPED

TINY = DQN(hidden=8)
RECIPE = zoo.Recipe.of(TINY)
FACTS = registry.load("world", "highway")().facts


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    return tmp_path


@pytest.fixture
def highway() -> DrivingWorld:
    return registry.load("world", "highway")()


@pytest.fixture
def saved(home: Path, highway: DrivingWorld) -> Path:
    return save(TINY, highway, seed=3)


def save(victim: DQN, world: DrivingWorld, *, seed: int, card: dict[str, object] | None = None) -> Path:
    torch.manual_seed(seed)
    return zoo.save(QPolicy(5, 5, victim.hidden), zoo.Recipe.of(victim), seed=seed, world=world, card=card or {})


def test_a_policy_loads_as_it_was_saved(saved: Path) -> None:
    torch.manual_seed(3)
    before, after = QPolicy(5, 5, 8).requires_grad_(False).eval(), zoo.load(RECIPE, 3, QPolicy)
    x = torch.rand(4, 10, 5)
    torch.testing.assert_close(after.scores(x), before.scores(x), rtol=0, atol=0)
    assert not any(weight.requires_grad for weight in after.parameters())
    assert after.weights_sha256 == zoo.card(RECIPE, 3)["sha256"]
    assert zoo.seeds(RECIPE) == [3]


def test_a_training_that_ended_with_nan_is_not_saved(home: Path, highway: DrivingWorld) -> None:
    """Infinite constants, as a mask has them, are no fault."""
    network = QPolicy(5, 5, 8)
    network.register_buffer("mask", torch.tensor(float("-inf")))
    zoo.save(network, RECIPE, seed=3, world=highway, card={})
    weight = next(network.parameters())
    with torch.no_grad():
        weight[0, 0] = float("nan")
    with pytest.raises(
        UserError, match=r"training dqn.*, seed 4 ended with NaN in 1 of \d+ tensors, '.*' the first"
    ) as error:
        zoo.save(network, RECIPE, seed=4, world=highway, card={})
    assert "\n" not in str(error.value)
    assert zoo.seeds(RECIPE) == [3]


def test_a_training_that_ended_with_infinity_is_not_saved(home: Path, highway: DrivingWorld) -> None:
    """A unit that is always off, or on, and finite answers: nothing else would tell."""
    network = QPolicy(5, 5, 8)
    with torch.no_grad():
        next(network.parameters())[0, 0] = -float("inf")
    with pytest.raises(UserError, match=r"ended with infinity in 1 of \d+ tensors, '.*' the first: nothing is saved"):
        zoo.save(network, RECIPE, seed=4, world=highway, card={})
    assert zoo.seeds(RECIPE) == []


@pytest.mark.parametrize("constant", [False, True])
def test_what_half_precision_would_make_infinite_is_not_saved(
    home: Path, highway: DrivingWorld, constant: bool
) -> None:
    network: Any = QPolicy(5, 5, 8)
    network.half_precision = True
    network.register_buffer("scale", torch.tensor([[65504.0, -float("inf")]]))
    zoo.save(network, RECIPE, seed=3, world=highway, card={})
    with torch.no_grad():
        (network.scale if constant else next(network.parameters()))[0, 0] = 70000.0
    with pytest.raises(UserError, match=r"ended with more than half precision holds \(65504\) in '.*'"):
        zoo.save(network, RECIPE, seed=4, world=highway, card={})
    assert zoo.seeds(RECIPE) == [3]


@pytest.mark.parametrize(("value", "what"), [("nan", "NaN"), ("-inf", "an infinite weight")])
def test_weights_with_nan_or_infinity_are_refused_whole_and_in_part(saved: Path, value: str, what: str) -> None:
    """Their card has the right hash."""
    tensors = load_file(saved)
    zoo.load_part(RECIPE, 3, "network", part := QPolicy(5, 5, 8).network)
    assert torch.equal(part.head[0].weight, tensors["network.head.0.weight"])
    tensors["network.head.0.weight"][0, 0] = float(value)
    saved.write_bytes(save_tensors(tensors))
    changed(saved, lambda entry: entry.update(sha256=hashlib.sha256(saved.read_bytes()).hexdigest()))
    for load in (lambda: zoo.load(RECIPE, 3, QPolicy), lambda: zoo.load_part(RECIPE, 3, "network", part)):
        with pytest.raises(UserError, match=rf"do not fit 'dqn': network\.head\.0\.weight has {what}"):
            load()


def test_tampered_weights_are_refused(saved: Path) -> None:
    blob = bytearray(saved.read_bytes())
    blob[-1] ^= 1
    saved.write_bytes(bytes(blob))
    with pytest.raises(UserError, match="the file was changed"):
        TINY.load(3, FACTS)


def test_weights_that_do_not_fit_are_refused_in_one_line(saved: Path) -> None:
    changed(saved, lambda entry: entry["shape"].update(hidden=9))
    with pytest.raises(UserError, match="do not fit 'dqn'") as error:
        TINY.load(3, FACTS)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "change",
    [
        {"recipe": 3},
        {"recipe": {"victim": [1]}},
        {"recipe": {"victim": {"parameters": 5}}},
        {"shape": 3},
        {"shape": {"hidden": "8"}},
        {"shape": {"hidden": 200_000}},
        {"start": {"sha256": 4}},
    ],
)
def test_a_card_of_another_form_is_refused_in_one_line_and_takes_no_memory(
    change: dict[str, Any], saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    linear = torch.nn.Linear.__init__

    def init(self: torch.nn.Linear, *sizes: int, **others: Any) -> None:
        linear(self, *sizes, **others)
        made.append(0 if self.weight.is_meta else self.weight.numel())

    monkeypatch.setattr(torch.nn.Linear, "__init__", init)
    changed(saved, lambda entry: entry.update(change))
    with pytest.raises(UserError) as error:
        TINY.load(3, FACTS)
    assert "\n" not in str(error.value)
    assert sum(made) < 10_000


def test_a_broken_card_is_named(saved: Path) -> None:
    saved.with_suffix(".json").write_text("{")
    with pytest.raises(UserError, match=r"card .*seed3\.json cannot be read"):
        TINY.load(3, FACTS)
    with pytest.raises(UserError, match="with a card that cannot be read"):
        TINY.load(4, FACTS)


def test_training_a_variant_never_hides_the_default(home: Path, highway: DrivingWorld) -> None:
    shipped = DQN().load(0, FACTS).weights_sha256
    save(DQN(hidden=64), highway, seed=0)
    save(DQN(trained_in="vehicles=5"), replace(highway, vehicles=5), seed=0)
    assert DQN().load(0, FACTS).weights_sha256 == shipped
    assert (
        len({DQN(**own).load(0, FACTS).weights_sha256 for own in ({}, {"hidden": 64}, {"trained_in": "vehicles=5"})})
        == 3
    )


@dataclass(frozen=True, kw_only=True)
class NewDQN(DQN):
    """The DQN of a later version, with one more parameter."""

    warm_up: int = 40


NewDQN.__qualname__ = "DQN"


@dataclass(frozen=True, kw_only=True)
class SlowDQN(DQN):
    """The DQN with another default."""

    gamma: float = 0.5


SlowDQN.__qualname__ = "DQN"


def as_of_bench(recipe: zoo.Recipe) -> zoo.Recipe:
    """The recipe of a test class as if it were part of bench."""
    (part,) = recipe.parts
    return replace(recipe, parts=(replace(part, source="bench.DQN"),))


def test_a_new_parameter_with_a_default_refuses_no_shipped_policy(home: Path) -> None:
    later = as_of_bench(zoo.Recipe.of(NewDQN()))
    assert later.key == zoo.Recipe.of(DQN()).key
    assert zoo.load(later, 0, QPolicy).weights_sha256 == DQN().load(0, FACTS).weights_sha256
    assert as_of_bench(zoo.Recipe.of(NewDQN(warm_up=1))).key != later.key


def test_a_default_that_has_changed_refuses_the_policy_of_the_old_one(home: Path) -> None:
    with pytest.raises(UserError, match=r"was made with victim\.gamma=0\.97, and the default is 0\.5 now"):
        zoo.load(as_of_bench(zoo.Recipe.of(SlowDQN())), 0, QPolicy)


def test_a_training_of_another_version_is_another_recipe(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = zoo.Recipe.of(DQN())
    monkeypatch.setattr(DQN, "training", 2)
    assert zoo.Recipe.of(DQN()).key != before.key
    with pytest.raises(UserError, match="training version 1 of victim, now 2"):
        DQN().load(0, FACTS)


def test_a_recipe_depends_on_values_not_on_their_notation() -> None:
    assert zoo.Recipe.of(DQN(gamma=1)).key == zoo.Recipe.of(DQN(gamma=1.0)).key  # type: ignore[arg-type]
    assert zoo.Recipe.of(DQN(hidden=128)).key == zoo.Recipe.of(DQN()).key
    assert zoo.Recipe.of(YOLOv5(trained=3)).key == zoo.Recipe.of(YOLOv5()).key
    of_another = zoo.Recipe.of(YOLOv5(trained=3), registry.load("defense", "advtrain_detection")())
    assert of_another.key != zoo.Recipe.of(YOLOv5(), registry.load("defense", "advtrain_detection")()).key


def test_a_missing_policy_lists_variants_and_the_training_command(saved: Path) -> None:
    with pytest.raises(UserError) as error:
        DQN(hidden=16, gamma=0.9).load(4, FACTS)
    said = str(error.value)
    assert "no 'dqn' with victim.hidden=16 victim.gamma=0.9 of training seed 4" in said
    assert re.search(r"default \(seeds 0, 1, 2[, \d]*\)", said)
    assert "victim.hidden=8 (seed 3)" in said
    assert "`bench train victim=dqn victim.hidden=16 victim.gamma=0.9 seeds=4`" in said
    assert "advtrain" not in said


def test_a_world_that_is_not_the_default_must_be_named(home: Path, highway: DrivingWorld) -> None:
    with pytest.raises(UserError, match=r"was trained in 'highway world\.vehicles=5', but its recipe says the default"):
        save(DQN(), replace(highway, vehicles=5), seed=0)
    with pytest.raises(UserError, match="its recipe says trained_in='vehicles=5'"):
        save(DQN(trained_in="vehicles=5"), highway, seed=0)


def test_the_shipped_policies_have_the_default_recipes(home: Path) -> None:
    dqn, ddpg = DQN(), DDPG()
    for seed in (0, 1, 2):
        hardened = [AdversarialTraining(skip=skip).load(dqn, seed, FACTS) for skip in (0.0, 0.3, 0.5, 1.0)]
        for policy in (dqn.load(seed, FACTS), *hardened):
            assert policy.decide(torch.zeros(2, 10, 5)).shape == (2,)
        for steering in (ddpg.load(seed, FACTS), AdversarialTraining().load(ddpg, seed, FACTS)):
            assert steering.decide(torch.zeros(2, 10, 5)).shape == (2, 2)


SHIPPED_CARDS = sorted(SHIPPED.rglob("*.json"))


@pytest.mark.parametrize("path", SHIPPED_CARDS, ids=[f"{path.parent.name}-{path.stem}" for path in SHIPPED_CARDS])
def test_the_command_of_a_shipped_card_gives_its_recipe(path: Path, home: Path) -> None:
    entry = json.loads(path.read_text())
    assert made_by(entry["command"]).key == path.parent.name
    assert entry["recipe"]["digest"].startswith(path.parent.name.rpartition("-")[2])
    assert path.stem == f"seed{entry['seed']}"


@pytest.mark.parametrize(
    ("victim", "defense", "world"),
    [
        (DQN(gamma=0.5, trained_in="vehicles=5"), None, {"vehicles": 5}),
        (
            DQN(trained_in="vehicles=5 'target_speeds=[20.0,25.5]'"),
            None,
            {"vehicles": 5, "target_speeds": (20.0, 25.5)},
        ),
        (DDPG(), AdversarialTraining(attack="zo", attack_params="steps=2 directions=3", skip=1), {}),
        (DQN(), AdversarialTraining(trained_in="preset=thesis"), {"preset": "thesis"}),
    ],
)
def test_the_command_of_a_card_trains_it_again_and_uses_it(
    victim: DQN, defense: AdversarialTraining | None, world: dict[str, object], home: Path
) -> None:
    recipe, where = zoo.Recipe.of(victim, defense), registry.load("world", "highway")(**world)
    zoo.save(QPolicy(5, 5, 8), recipe, seed=7, world=where, card={})
    entry = zoo.card(recipe, 7)
    assert made_by(entry["command"]).key == recipe.key
    assert training_of(shlex.split(entry["command"])[2:]).seeds == (7,)
    (pair,) = plan_of(shlex.split(recipe.use)[2:]).pairs
    assert (pair.victim.component, pair.defense.component) == (victim, defense or pair.defense.component)


def made_by(command: str) -> zoo.Recipe:
    """The recipe that a `bench train` command makes."""
    program, train, *options = shlex.split(command)
    assert (program, train) == ("bench", "train")
    config = training_of(options)
    world = config.world.component
    trained_in = zoo.trained_in(world, default=track(world.tracks()[0]).world)
    parts = {
        part.kind: part.component for part in (config.victim, config.defense, config.attack) if part.name != "none"
    }
    kind = config.trained.kind
    return zoo.Recipe.of(**parts | {kind: replace(parts[kind], trained_in=trained_in)})


def test_a_card_is_enough_to_train_the_policy_again(home: Path, highway: DrivingWorld) -> None:
    save(TINY, highway, seed=3, card={"selection": "best of one"})
    entry = zoo.card(RECIPE, 3)
    assert entry["recipe"]["victim"]["changed"] == {"hidden": 8}
    assert entry["recipe"]["victim"]["parameters"]["decisions"] == 36_000
    assert entry["recipe"]["victim"]["training"] == 1
    assert entry["world"]["parameters"]["vehicles"] == 20
    assert entry["selection"] == "best of one"
    assert entry["command"] == "bench train victim=dqn victim.hidden=8 seeds=3"
    assert set(entry["made"]) == {"cavbench", "code", "libraries", "machine", "at"}
    assert all(entry["made"].values())


def test_the_zoo_depends_on_no_track() -> None:
    found = sources(["cavbench.zoo.store"])
    assert not [name for name in found if name.startswith(("cavbench.driving", "cavbench.detection"))]


def test_a_detector_is_stored_in_half_precision(home: Path) -> None:
    torch.manual_seed(0)
    victim = YOLOv5(updates=1)
    world: CameraWorld = registry.load("world", "camera")()
    network = YOLOv5Network("n", ("stop sign", "car")).eval()
    path = zoo.save(network, zoo.Recipe.of(victim), seed=0, world=world, card={"scenes": 3})
    again = victim.load(0, world.facts)
    assert again.names == ("stop sign", "car")
    assert again.weights_sha256 == zoo.card(zoo.Recipe.of(victim), 0)["sha256"]
    picture = torch.rand(1, 3, 64, 64)
    torch.testing.assert_close(again(picture).scores, network(picture).scores, rtol=0.01, atol=1e-4)
    assert path.stat().st_size < 2.1 * sum(weight.numel() for weight in network.state_dict().values())


START = "5" * 64


def start(sha256: str = START) -> QPolicy:
    """The network that a training starts from, with a hash."""
    torch.manual_seed(0)
    network = QPolicy(5, 5, 8)
    network.weights_sha256 = sha256
    return network


@pytest.fixture
def partial(home: Path, highway: DrivingWorld) -> tuple[Path, QPolicy]:
    """An entry whose training changed one tensor, and its network."""
    network = start()
    with torch.no_grad():
        next(iter(network.parameters())).add_(1)
    path = zoo.save(network, RECIPE, seed=3, world=highway, card={}, start=start())
    return path, network


def test_only_what_a_training_changed_is_stored_and_the_rest_is_its_start(partial: tuple[Path, QPolicy]) -> None:
    path, network = partial
    key, *others = network.state_dict()
    assert list(load_file(path)) == [key]
    assert zoo.card(RECIPE, 3)["start"] == {"sha256": START, "tensors": others}
    again = zoo.load(RECIPE, 3, lambda **_: start())
    for name, value in network.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name
    assert again.weights_sha256 == zoo.card(RECIPE, 3)["sha256"] != START


def test_another_start_is_refused(partial: tuple[Path, QPolicy]) -> None:
    for other in ("6" * 64, ""):
        with pytest.raises(
            UserError, match=r"'dqn', seed 3, started from weights 555555555555….*`bench train victim=dqn"
        ):
            zoo.load(RECIPE, 3, lambda other=other, **_: start(other))


def test_a_card_that_does_not_name_every_tensor_once_is_refused(partial: tuple[Path, QPolicy]) -> None:
    path, network = partial
    key, *others = network.state_dict()
    for tensors in (others[1:], [key, *others], ["tail", *others]):
        changed(path, lambda entry, tensors=tensors: entry["start"].update(tensors=tensors))
        with pytest.raises(UserError, match="do not fit 'dqn'") as error:
            zoo.load(RECIPE, 3, lambda **_: start())
        assert "\n" not in str(error.value)


def test_without_a_hash_of_the_start_everything_is_stored(home: Path, highway: DrivingWorld) -> None:
    path = zoo.save(start(""), RECIPE, seed=3, world=highway, card={}, start=start(""))
    assert load_file(path).keys() == start().state_dict().keys()
    assert "start" not in zoo.card(RECIPE, 3)


def changed(path: Path, change: object) -> None:
    """Change the card beside the weights."""
    card = path.with_suffix(".json")
    entry = json.loads(card.read_text())
    change(entry)  # type: ignore[operator]
    card.write_text(json.dumps(entry))
