"""YOLOv5: its sizes, and loading it from a user's file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cavbench import zoo
from cavbench.detection import STOP_SIGN
from cavbench.detection.approach import score
from cavbench.detection.boxes import confidence, overlap
from cavbench.detection.victims import yolov5_file
from cavbench.detection.victims.examples import Example
from cavbench.detection.victims.yolov5 import MULTIPLES, Size, YOLOv5, YOLOv5Network, sign_of
from cavbench.envs.camera.axes import AXES
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError
from tests.detection.drawn_street import DrawnStreet

FACTS = StopSignApproach().facts

PUBLISHED = {"n": 1_872_157, "s": 7_235_389, "m": 21_190_557, "l": 46_563_709, "x": 86_749_405}


@pytest.mark.parametrize("size", MULTIPLES)
def test_it_has_the_published_sizes(size: Size) -> None:
    with torch.device("meta"):
        network = YOLOv5Network(size)
    assert sum(weight.numel() for weight in network.parameters()) == PUBLISHED[size]


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[YOLOv5Network, Path]:
    torch.manual_seed(0)
    network = YOLOv5Network("n", ("stop sign", "car")).eval()
    path = tmp_path_factory.mktemp("yolov5") / "own.safetensors"
    yolov5_file.save(network, path)
    return network, path


def test_saved_weights_load_unchanged(saved: tuple[YOLOv5Network, Path]) -> None:
    network, path = saved
    loaded = YOLOv5(path=str(path)).load(0, FACTS)
    pictures = torch.rand(1, 3, 64, 64)
    torch.testing.assert_close(loaded(pictures).scores, network(pictures).scores, rtol=0, atol=1e-5)
    assert loaded.names == ("stop sign", "car")
    assert len(loaded.weights_sha256) == 64
    assert not loaded.training
    assert not any(weight.requires_grad for weight in loaded.parameters())


def test_a_size_that_does_not_match_the_file_is_refused_in_one_line(saved: tuple[YOLOv5Network, Path]) -> None:
    with pytest.raises(UserError, match=r"does not hold a YOLOv5s \(victim.size\): size mismatch for model") as error:
        YOLOv5(size="s", path=str(saved[1])).load(0, FACTS)
    assert "\n" not in str(error.value)


def test_without_trained_weights_the_error_names_the_path_option() -> None:
    with pytest.raises(UserError, match=r"set victim\.path=yolov5m\.pt to use your own file"):
        YOLOv5(size="m").load(0, FACTS)


def test_a_trained_detector_is_found_in_the_zoo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    victim = YOLOv5(updates=3, batch=2, window=64, trained_in="DrawnStreet")
    told: list[str] = []
    made = victim.train(DrawnStreet(), seed=4, progress=lambda share, text: told.append(text))
    assert made.network.names == (STOP_SIGN,)
    assert made.card["frames"] == len(DrawnStreet().training_scenes())
    assert told[0].startswith("loss ")
    zoo.save(made.network, zoo.Recipe.of(victim), seed=4, world=DrawnStreet(), card=made.card)
    loaded = replace(victim, trained=4).load(0, FACTS)
    rounded = {
        name: value.half().float() if value.ndim > 1 else value for name, value in made.network.state_dict().items()
    }
    made.network.load_state_dict(rounded)
    pictures = torch.rand(1, 3, 64, 64)
    torch.testing.assert_close(loaded(pictures).scores, made.network(pictures).scores, rtol=1e-3, atol=1e-4)
    with pytest.raises(UserError, match=r"victim\.updates=4 .* Variants: .*victim\.updates=3.*seed 4"):
        replace(victim, trained=4, updates=4).load(0, FACTS)
    with pytest.raises(UserError, match="is trained already"):
        YOLOv5(path="own.pt").train(DrawnStreet(), seed=0, progress=lambda share, text: None)


@pytest.mark.parametrize("bad", [{"updates": 0}, {"window": 100}, {"learning_rate": 0.0}, {"trained": -1}])
def test_a_recipe_out_of_range_is_named(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        YOLOv5(**bad)


def test_caution_counts_the_surest_stop_sign_that_is_not_there() -> None:
    torch.manual_seed(0)
    network = YOLOv5Network("n", ("stop sign", "car")).eval()
    box = torch.tensor([[8.0, 8.0, 40.0, 40.0]])
    signs = Example(torch.rand(2, 3, 64, 64), [box, box], [torch.tensor([0]), torch.tensor([1])])
    boxes, there = sign_of(signs, 0)
    assert there.tolist() == [True, False]
    assert boxes.tolist() == [box[0].tolist(), [0.0] * 4]
    with torch.no_grad():
        plain, cautious = (YOLOv5(caution=weight).loss(network, signs) for weight in (0.0, 3.0))
        scores = network(signs.pictures).scores_of(0)
        away = overlap(network(signs.pictures).boxes[0], box) == 0
    surest = torch.stack([scores[0][away].max(), scores[1].max()])
    torch.testing.assert_close(cautious - plain, -3 * (1 - surest).log().mean())


@pytest.mark.slow
def test_the_shipped_detector_finds_held_out_signs() -> None:
    detector, world = YOLOv5().load(0, FACTS), StopSignApproach()
    for approach in world.approaches(AXES.cell(lanes=3, density=1.0), range(3)):
        frames = torch.arange(len(approach.scenes))
        predictions = detector(approach.scenes.render(frames, None, 0.5))
        seen = confidence(predictions, detector.index(STOP_SIGN), approach.scenes.boxes)
        assert seen.mean() > 0.6
        assert (seen[5:] > 0.5).all()


@pytest.mark.slow
def test_the_shipped_detector_takes_no_decoy_for_a_stop_sign() -> None:
    world = StopSignApproach()
    approaches = world.approaches(AXES.cell(lanes=3, density=1.0), range(3))
    measured = score(YOLOv5().load(0, FACTS), approaches, None, share=0.5)
    assert measured["false_stops"].mean() < 0.05
    assert measured["average_precision"].mean() >= 0.85
