"""YOLOv5: its sizes, and loading it from a user's file."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from bench.errors import UserError
from bench.victims import yolov5_file
from bench.victims.yolov5 import MULTIPLES, Size, YOLOv5, YOLOv5Network

PUBLISHED = {"n": 1_872_157, "s": 7_235_389, "m": 21_190_557, "l": 46_563_709, "x": 86_749_405}


@pytest.mark.parametrize("size", MULTIPLES)
def test_its_sizes_are_the_published_ones(size: Size) -> None:
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


def test_what_is_saved_is_what_is_loaded(saved: tuple[YOLOv5Network, Path]) -> None:
    network, path = saved
    loaded = YOLOv5(path=str(path)).load(0)
    pictures = torch.rand(1, 3, 64, 64)
    torch.testing.assert_close(loaded(pictures).scores, network(pictures).scores, rtol=0, atol=1e-5)
    assert loaded.names == ("stop sign", "car")
    assert len(loaded.weights_sha256) == 64
    assert not loaded.training
    assert not any(weight.requires_grad for weight in loaded.parameters())


def test_another_size_than_the_files_is_refused_in_one_line(saved: tuple[YOLOv5Network, Path]) -> None:
    with pytest.raises(UserError, match=r"does not hold a YOLOv5s \(victim.size\): size mismatch for model") as error:
        YOLOv5(size="s", path=str(saved[1])).load(0)
    assert "\n" not in str(error.value)


def test_without_a_file_it_says_how_to_name_one() -> None:
    with pytest.raises(UserError, match=r"victim\.path=yolov5m\.pt names a file of yours"):
        YOLOv5(size="m").load(0)
