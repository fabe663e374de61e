"""A pair of a plug-in is submitted, and verified by somebody else; what was changed or is missing is found."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from cavbench.core import registry
from cavbench.core.track import track
from cavbench.records import reading
from cavbench.run.claims import _names_a_file
from cavbench.run.config import plan_of
from cavbench.run.submission import weights_of
from tests.command import Said

Bench = Callable[..., Said]
RUN = (
    "run", "attack=nudge", "defense=guard", "defense.digits=2", "victim=toy", "world=toy", "lanes=3,4", "density=1",
    "weather=clear", "episodes=10", "seeds=0,1", "executor=serial", "record=0",
)  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for `results` and `submission`, which the first test fills."""
    return tmp_path_factory.mktemp("made")


@pytest.fixture
def submission(bench: Bench, made: Path, tmp_path: Path) -> Path:
    """A submission of its own for a test, beside the results that it was written from."""
    if not (made / "submission").exists():
        assert bench(*RUN, f"out={made / 'results'}").code == 0
        said = bench("submit", "nudge-guard", f"results={made / 'results'}", f"out={made / 'submission'}")
        assert said.code == 0, said.err
    for name in ("results", "submission"):
        shutil.copytree(made / name, tmp_path / name)
    return tmp_path / "submission"


def test_a_submission_is_verified_and_becomes_a_row(bench: Bench, submission: Path, tmp_path: Path) -> None:
    about = json.loads((submission / "submission.json").read_text())
    assert about["packages"] == ["cavbench-toy 1.0"]
    assert about["commands"]["install"] == "pip install cavbench-toy==1.0"
    said = bench("verify", str(submission), "audit=false", f"out={tmp_path / 'board'}")
    assert said.code == 0, said.err + said.out
    assert "execute the code of cavbench" in said.out
    assert "cavbench-toy 1.0" in said.out
    assert said.out.count("bit for bit the same") == 4
    assert "The submission holds." in said.out
    board = reading.read(tmp_path / "board", track=track("driving"))
    assert {"nudge", "none"} == set(board["attack"].to_pylist())
    assert bench("report", "leaderboard", f"out={tmp_path / 'board'}").code == 0


def test_fresh_scenarios_are_compared_with_the_submitted_ones(bench: Bench, submission: Path) -> None:
    said = bench("verify", str(submission), "sample=1", "episodes=10", "salt=7")
    assert "Fresh scenarios (salt=7), 10 a cell" in said.out
    # The toy's episodes depend on hardly more than the parity of the seed, so that the drawn ones may differ.
    assert ("public_only" in said.out) == (said.code == 1)


def test_too_few_scenarios_are_no_evidence(bench: Bench, tmp_path: Path) -> None:
    results, folder = tmp_path / "results", tmp_path / "submission"
    few = [word.replace("episodes=10", "episodes=4") for word in RUN]
    assert bench(*few, f"out={results}").code == 0
    assert bench("submit", "nudge-guard", f"results={results}", f"out={folder}").code == 0
    said = bench("verify", str(folder), "sample=1")
    assert (said.code, "does not hold: it has 4 scenarios a cell, and an audit needs 10" in said.out) == (1, True)
    assert "at least 10, got 3" in bench("verify", str(folder), "episodes=3").err


def test_its_command_drives_the_same_records(bench: Bench, submission: Path, tmp_path: Path) -> None:
    words = json.loads((submission / "submission.json").read_text())["commands"]["run"].split()[1:]
    assert bench(*words, "executor=serial", "record=0", f"out={tmp_path / 'again'}").code == 0
    driven = {path.name for path in (tmp_path / "again" / "episodes").glob("*.parquet")}
    assert {path.name for path in (submission / "episodes").glob("*.parquet")} <= driven


def test_changed_scores_are_found_though_the_hashes_fit(bench: Bench, submission: Path) -> None:
    about = json.loads((submission / "submission.json").read_text())
    for name in about["files"]:
        path = submission / name
        records = pq.read_table(path)
        if records["attack"][0].as_py() == "nudge":
            better = records.set_column(
                records.schema.get_field_index("safe_progress"),
                records.schema.field("safe_progress"),
                [[1.0] * records.num_rows],
            )
            pq.write_table(better.cast(records.schema), path)
            about["files"][name] = hashlib.sha256(path.read_bytes()).hexdigest()
    (submission / "submission.json").write_text(json.dumps(about))
    said = bench("verify", str(submission), "audit=false", "sample=all")
    assert said.code == 1
    assert "though nothing has changed" in said.out
    assert "The submission does not hold: what was driven again differs" in said.out


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda folder: next(folder.glob("episodes/*")).write_bytes(b"x"), "is missing, or not as"),
        (lambda folder: (folder / "run.py").write_text("print('executed')"), "is not allowed in a submission"),
        (lambda folder: (folder / "weights.pt").symlink_to("/etc/passwd"), "is not allowed in a submission"),
        (lambda folder: (folder / "zoo.json").write_text("{}"), "is not allowed in a submission"),
        (
            lambda folder: (folder / "episodes" / f"{'0' * 64}.parquet").write_text("{}"),
            "is not listed in submission.json",
        ),
        (lambda folder: (folder / "submission.json").write_text("[]"), "is not a submission"),
    ],
)
def test_files_that_are_not_as_described_are_refused(
    change: Callable[[Path], object], line: str, bench: Bench, submission: Path
) -> None:
    change(submission)
    said = bench("verify", str(submission))
    assert said.code == 2
    assert line in said.err
    assert "executed" not in said.out


def test_a_missing_plug_in_is_named_before_anything_is_executed(
    bench: Bench, submission: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = registry.entries
    monkeypatch.setattr(
        registry,
        "entries",
        lambda group: {k: v for k, v in known(group).items() if v[0].distribution != "cavbench-toy"},
    )
    said = bench("verify", str(submission))
    assert said.code == 2
    assert "shipped by cavbench-toy 1.0, it is not installed" in said.err
    assert "pip install cavbench-toy==1.0" in said.err


def test_only_a_whole_grid_and_a_new_folder_are_taken(bench: Bench, submission: Path, tmp_path: Path) -> None:
    said = bench("submit", "nudge-guard", f"results={tmp_path / 'results'}", f"out={submission}")
    assert (said.code, "is not empty" in said.err) == (2, True)
    assert bench("submit", "nudge-guard", f"results={tmp_path / 'results'}").code == 2


def test_a_patch_is_crafted_again_not_taken(bench: Bench, tmp_path: Path) -> None:
    results, folder, board = (tmp_path / name for name in ("results", "submission", "board"))
    words = (
        "attack=paint",
        "victim=red",
        "world=red_street",
        "lanes=3",
        "density=1",
        "weather=clear,fog",
        "seeds=0",
        "record=0",
    )
    assert bench("run", *words, "executor=serial", f"out={results}").code == 0
    assert bench("submit", "paint", f"results={results}", f"out={folder}").code == 0
    said = bench("verify", str(folder), f"out={board}")
    assert said.code == 0, said.err + said.out
    assert said.out.count("bit for bit the same") == 2
    (patch,) = (folder / "patches").iterdir()
    assert (board / "patches" / patch.name).exists()
    # A weak patch under the name of the strong one, and the records that it gives.
    weak = bench("run", "attack=blank", *words[1:], "executor=serial", f"out={tmp_path / 'weak'}")
    assert weak.code == 0
    driven = reading.read(tmp_path / "weak", track=track("detection"))
    score = driven.filter(pc.equal(driven["attack"], "blank"))["stop_score"][0].as_py()
    about = json.loads((folder / "submission.json").read_text())
    for path in (folder / "episodes").iterdir():
        records = pq.read_table(path)
        place = records.schema.get_field_index("stop_score")
        scores = pa.array([score] * records.num_rows, pa.float64())
        pq.write_table(records.set_column(place, records.schema.field(place), scores), path)
        about["files"][f"episodes/{path.name}"] = hashlib.sha256(path.read_bytes()).hexdigest()
    patch.write_bytes(next((tmp_path / "weak" / "patches").iterdir()).read_bytes())
    about["files"][f"patches/{patch.name}"] = hashlib.sha256(patch.read_bytes()).hexdigest()
    (folder / "submission.json").write_text(json.dumps(about))
    said = bench("verify", str(folder), f"out={tmp_path / 'other'}")
    assert (said.code, "it differs in stop_score" in said.out) == (1, True)
    assert not list((tmp_path / "other").glob("episodes/*"))


def test_a_detector_is_submitted_with_the_weights_of_its_own_training_seed(toy_folder: Path) -> None:
    words = "attack=eot victim=yolov5 victim.trained=3 world=camera"
    (pair,) = plan_of(words.split()).pairs
    assert {name.rpartition("/")[2] for name in weights_of(pair, [0, 1])} >= {"seed3.safetensors", "seed3.json"}
    (hardened,) = plan_of(["attack=eot", "victim=yolov5", "defense=advtrain+masking", "world=camera"]).pairs
    weights = {name.split("/")[-2].rpartition("-")[0] for name in weights_of(hardened, [0])}
    assert weights == {"yolov5n", "yolov5n-advtrain-eot-skip0.3", "yolov5n-masking"}
    (from_file,) = plan_of(
        ["attack=grey_patch", "victim=detector", "victim.path=x.onnx", "defense=masking", "world=camera"]
    ).pairs
    assert weights_of(from_file, [0]) == {}
    # Its parameter `path` is empty: it names no file of this machine.
    assert not _names_a_file(json.loads(pair.victim.params))
    assert _names_a_file({"links": [{"path": "/etc/passwd"}]})
