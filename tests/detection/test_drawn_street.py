"""End-to-end test with a real detector: a patch is crafted on a drawn street and scored on unseen approaches."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from cavbench.core import registry
from cavbench.core.track import track
from cavbench.detection.victims.yolov3_tiny import YOLOv3TinyNetwork
from cavbench.records import reading
from cavbench.run.replay import find, replay
from tests.command import Said
from tests.detection.test_recording import bars
from tests.driving.test_recording import read
from tests.plugins.distributions import install

WORDS = ("victim=yolov3_tiny", "world=drawn", "lanes=3", "density=1", "episodes=2", "seeds=0")


def mean(records: pa.Table, attack: str, weather: str, column: str = "confidence_mean") -> float:
    kept = records.filter(
        (pc.field("attack") == attack) & pc.match_substring(pc.field("cell"), f'"weather":"{weather}"')
    )
    return float(pc.mean(kept[column].cast(pa.float64())).as_py())


@pytest.mark.slow
def test_a_patch_hides_a_sign_from_yolo_and_fog_alone_does_less(
    bench: Callable[..., Said], plugins: Path, tmp_path: Path, published: YOLOv3TinyNetwork
) -> None:
    points = {
        "cavbench.worlds": {"drawn": "tests.detection.drawn_street:DrawnStreet"},
        "cavbench.grids": {"drawn-v1": "tests.detection.drawn_street:DRAWN_V1"},
    }
    install(plugins, "drawn", points, {})
    registry.installed.cache_clear()
    attack = ("attack=paint,blank", "attack.texels=32", "attack.steps=15")
    said = bench("run", *attack, *WORDS, "weather=clear,fog", "workers=2", f"out={tmp_path}")
    assert said.code == 0, said.err
    assert "yolov3_tiny" in said.out
    records = reading.read(tmp_path, track=track("detection"))
    assert set(records["attack"].to_pylist()) == {"none", "paint", "blank", "noise_patch", "grey_patch", "plain_patch"}
    assert records.num_rows == 7 * 2 * 2
    assert mean(records, "none", "clear") > 0.7
    assert mean(records, "none", "clear", "ran") == 0
    assert mean(records, "none", "fog") < mean(records, "none", "clear")
    assert mean(records, "paint", "clear") < 0.5 * mean(records, "none", "clear")
    assert mean(records, "paint", "clear") < mean(records, "blank", "clear")
    assert set(records["weights_sha256"].to_pylist()) == {records["weights_sha256"][0].as_py()}
    record = find(records, {"attack": "paint", "weather": "fog"})
    again = replay(tmp_path, record)
    assert again.differences == ()
    confidence = bars(read(again.path)["/confidence/with_patch"])
    np.testing.assert_allclose(confidence, record["frame_confidence"])
