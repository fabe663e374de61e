"""The zoo: what is saved is what is loaded, and nothing else is."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from bench.errors import UserError
from bench.victims import zoo
from bench.victims.detectors.yolov5 import YOLOv5Network
from bench.victims.drivers.ddpg import DDPG
from bench.victims.drivers.dqn import DQN
from bench.victims.drivers.networks import QPolicy
from defenses.advtrain import AdversarialTraining

MADE_BY = {"victim": {"gamma": 0.9}}


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    return tmp_path


@pytest.fixture
def saved(home: Path) -> Path:
    torch.manual_seed(0)
    return zoo.save(QPolicy(5, 5, 8), MADE_BY, name="tiny", seed=3)


def test_a_policy_comes_back_as_it_was_saved(saved: Path) -> None:
    torch.manual_seed(0)
    before, after = QPolicy(5, 5, 8), zoo.load("tiny", 3, QPolicy, made_by=MADE_BY)
    x = torch.rand(4, 10, 5)
    torch.testing.assert_close(after.scores(x), before.scores(x), rtol=0, atol=0)
    assert not any(weight.requires_grad for weight in after.parameters())
    assert after.weights_sha256 == zoo.card("tiny", 3)["sha256"]
    assert zoo.seeds("tiny") == [3]


def test_tampered_weights_are_refused(saved: Path) -> None:
    blob = bytearray(saved.read_bytes())
    blob[-1] ^= 1
    saved.write_bytes(bytes(blob))
    with pytest.raises(UserError, match="the file was changed"):
        zoo.load("tiny", 3, QPolicy, made_by=MADE_BY)


def test_weights_that_do_not_fit_are_refused_in_one_line(saved: Path) -> None:
    card = saved.with_suffix(".json")
    entry = json.loads(card.read_text())
    entry["shape"]["hidden"] = 9
    card.write_text(json.dumps(entry))
    with pytest.raises(UserError, match="do not fit 'tiny'") as error:
        zoo.load("tiny", 3, QPolicy, made_by=MADE_BY)
    assert "\n" not in str(error.value)


def test_another_recipe_than_the_one_asked_for_is_refused(saved: Path) -> None:
    with pytest.raises(UserError, match=r"made with victim\.gamma=0\.9, not 0\.5"):
        zoo.load("tiny", 3, QPolicy, made_by={"victim": {"gamma": 0.5}})


def test_a_missing_policy_names_the_seeds_there_are(saved: Path) -> None:
    with pytest.raises(UserError, match="it has seeds 3"):
        zoo.load("tiny", 4, QPolicy, made_by={})
    with pytest.raises(UserError, match="bench train"):
        zoo.load("nobody", 0, QPolicy, made_by={})


def test_a_broken_card_is_named(saved: Path) -> None:
    saved.with_suffix(".json").write_text("{")
    with pytest.raises(UserError, match=r"card .*seed3\.json cannot be read"):
        zoo.load("tiny", 3, QPolicy, made_by={})


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_shipped_policies_are_those_of_the_default_recipes(seed: int, home: Path) -> None:
    dqn, ddpg = DQN(), DDPG()
    hardened = [AdversarialTraining(skip=skip).load(dqn, seed) for skip in (0.0, 0.3, 0.5, 1.0)]
    for policy in (dqn.load(seed), *hardened):
        assert policy.decide(torch.zeros(2, 10, 5)).shape == (2,)
    assert ddpg.load(seed).decide(torch.zeros(2, 10, 5)).shape == (2, 2)


@pytest.mark.usefixtures("home")
def test_a_detector_is_kept_like_a_policy_in_half_precision() -> None:
    torch.manual_seed(0)
    network = YOLOv5Network("n", ("stop sign", "car")).eval()
    zoo.save(network, {"scenes": 3}, name="yolov5n", seed=0)
    again = zoo.load("yolov5n", 0, YOLOv5Network, made_by={})
    assert again.names == ("stop sign", "car")
    assert again.weights_sha256 == zoo.card("yolov5n", 0)["sha256"]
    picture = torch.rand(1, 3, 64, 64)
    torch.testing.assert_close(again(picture).scores, network(picture).scores, rtol=0.01, atol=0)
    path = zoo.own() / "yolov5n" / "seed0.safetensors"
    assert path.stat().st_size < 2.1 * sum(weight.numel() for weight in network.state_dict().values())
