"""A detector from a file is attacked, scored, shown and replayed like any other."""

from __future__ import annotations

from pathlib import Path

import pyarrow.compute as pc
import pytest

import cavbench
from cavbench.records import reading
from cavbench.run.replay import replay
from tests.detection.test_detection import Bench
from tests.detection.victims.test_from_file import NAMES, RedCells, onnx_file, torch_file
from tests.detection.victims.test_wrappings import Anywhere

pytestmark = pytest.mark.usefixtures("toy_folder")
WORDS = (
    *("world=red_street", "lanes=3", "density=1", "weather=clear", "seeds=0", "executor=serial", "record=0"),
    *("victim=detector", f"victim.names={NAMES}", "victim.frame=32"),
)


@pytest.fixture(autouse=True)
def without_reference_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cavbench.detection.track.REFERENCE_PATCHES", ())


def test_a_program_is_attacked_with_gradients_from_the_command_line(tmp_path: Path, bench: Bench) -> None:
    path, out = torch_file(tmp_path / "red.pt2"), tmp_path / "out"
    eot = ("attack=eot", "attack.steps=30", "attack.batch=4", "attack.texels=16", "attack.learning_rate=0.3")
    said = bench("run", *eot, *WORDS, "threat.budget=1", f"victim.path={path}", f"out={out}")
    assert said.code == 0, said.err
    records = reading.read_all(out)["detection"]
    rows = {name: records.filter(pc.field("attack") == name).to_pylist()[0] for name in ("eot", "none")}
    assert rows["eot"]["gradient_queries"] == 120
    assert rows["eot"]["zero_gradients"] == 0
    assert rows["eot"]["inconsistent"] == 0
    assert len(rows["eot"]["weights_sha256"]) == 64
    assert rows["none"]["confidence_mean"] > 0.5
    assert rows["eot"]["confidence_mean"] < 0.8 * rows["none"]["confidence_mean"]
    again = replay(out, rows["eot"])
    assert (again.changed, again.differences) == ("", ())


def test_an_onnx_detector_is_a_black_box_on_the_command_line(tmp_path: Path, bench: Bench) -> None:
    words = (*WORDS, f"victim.path={onnx_file(tmp_path / 'red.onnx')}", f"out={tmp_path / 'out'}")
    said = bench("run", "attack=noise_patch", *words)
    assert said.code == 0, said.err
    refused = bench("run", "attack=eot", *words)
    assert refused.code != 0
    assert "attack 'eot' needs access 'gradients', but victim 'detector' is a black box" in refused.err
    assert len(refused.err.strip().splitlines()) == 1
    hardened = bench("run", "attack=noise_patch", "defense=advtrain", *words)
    assert hardened.code != 0
    assert "a detector in a file cannot be trained" in hardened.err
    assert "Error:" not in hardened.err


def test_a_module_of_the_session_has_the_score_of_its_file(tmp_path: Path) -> None:
    where = {"world": "red_street", "lanes": 3, "density": 1, "weather": "clear", "seeds": [0], "baselines": False}
    eot = cavbench.component("attack", "eot", steps=10, batch=4, texels=16, learning_rate=0.3)
    path = torch_file(tmp_path / "red.pt2")
    file = cavbench.component("victim", "detector", path=path, names=NAMES, frame=32)
    given = cavbench.detector(Anywhere(RedCells()), names=NAMES)
    found = [
        cavbench.score(victim, eot, threat={"budget": 1.0}, out=tmp_path / "out", **where) for victim in (file, given)
    ]
    for column in ("stop_score", "queries"):
        assert list(found[0][column].fillna(0)) == pytest.approx(list(found[1][column].fillna(0)), abs=1e-5)
    assert found[1].victim[0].startswith("Anywhere-")
    attacked, clean = found[1].stop_score
    assert attacked < clean
    with pytest.raises(cavbench.UserError, match="a detector that is an object cannot be trained"):
        cavbench.score(given, eot, "advtrain", out=tmp_path / "out", **where)
    with pytest.raises(cavbench.UserError, match="the victim of a camera world is one detector, got 2"):
        cavbench.score([RedCells(), RedCells()], eot, **where)
