"""Runs of the detection track: a patch is crafted once and kept; everything else is as on the driving track."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pytest
from safetensors import safe_open

from cavbench import zoo
from cavbench.cli.show import recordings
from cavbench.core.sources import names, tracks_of
from cavbench.core.track import track
from cavbench.detection.patch import Patch
from cavbench.detection.printing import non_printability
from cavbench.detection.threat import PatchThreat
from cavbench.errors import UserError
from cavbench.identity import fingerprint
from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.records import reading
from cavbench.run import runner
from cavbench.run.config import component, plan_of, training_of
from cavbench.run.plan import Plan
from cavbench.run.replay import find, replay
from cavbench.run.task import Task
from tests.cli.test_cli import TOY, assert_one_line
from tests.command import Said
from tests.plugins.distributions import install
from tests.run.test_runner import Silent

pytestmark = pytest.mark.usefixtures("toy_folder")

Bench = Callable[..., Said]
SMALL = "attack=paint victim=red world=red_street lanes=3 density=1 weather=clear,fog seeds=0,1"
BESIDE = ["created_at", "wall_s", "crafting_s", "entropy"]


def read(line: str) -> Plan:
    return plan_of(line.split())


def run(out: Path, *more: str, watcher: Silent | None = None) -> tuple[pa.Table, Silent]:
    words = dict(word.split("=", 1) for word in [*SMALL.split(), "executor=serial", f"out={out}", "record=0", *more])
    watcher = watcher or Silent()
    units = runner.run(plan_of([f"{key}={value}" for key, value in words.items()]), watcher)
    return reading.read(out, units, track=track("detection")), watcher


def crafted(watcher: Silent) -> list[Task]:
    return [task for task in watcher.done if task.step == "prepare"]


def patch_path(out: Path, fingerprint: str) -> Path:
    return out / "patches" / f"{fingerprint}.safetensors"


@pytest.fixture(autouse=True)
def without_reference_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run without baselines, unless a test asks for them."""
    monkeypatch.setattr("cavbench.detection.track.REFERENCE_PATCHES", ())


def test_the_victim_determines_the_track_and_the_track_the_defaults() -> None:
    config = read("attack=paint victim=red world=red_street")
    (pair,) = config.pairs
    assert (pair.threat.norm, pair.threat.budget, pair.threat.queries) == ("patch", 0.5, 20_000)
    assert config.grid.name == "red-v1"
    assert read("victim=red world=red_street weather=night").grid.values["weather"] == ("night",)
    assert read("victim=red").pairs[0].world.name == "camera"


BAD = {
    "attack=noise victim=red world=red_street": "attack 'noise' does not fit victim 'red' of the detection track; fitting:",
    "attack=paint victim=toy world=toy": "attack 'paint' does not fit victim 'toy' of the driving track; fitting: art, bias",
    "victim=red world=highway": "world 'highway' does not fit victim 'red' of the detection track; fitting: ",
    "victim=toy,red": "victims 'toy' (driving) and 'red' (detection) belong to different tracks",
    "victim=red world=red_street threat.norm=linf": "unknown threat.norm 'linf'; known: patch, print",
    "victim=red world=red_street threat.budget=1.5": "threat.budget must be in (0, 1]",
    "attack=paint victim=red world=red_street threat.budget=0": "threat.budget must be in (0, 1]",
    "attack=paint victim=red world=red_street threat.access=scores": "needs access 'gradients'",
    "victim=toy world=toy grid=approach-v1": "unknown grid 'approach-v1' of the world 'toy'",
    "victim=toy world=toy threat.norm=patch": "unknown threat.norm 'patch'; known: relative, linf",
}


@pytest.mark.parametrize("line", BAD)
def test_components_of_another_track_are_refused_in_one_line(line: str) -> None:
    with pytest.raises(UserError) as raised:
        read(line)
    assert BAD[line] in str(raised.value)
    assert "\n" not in str(raised.value)


def test_the_track_of_a_component_is_read_from_its_source() -> None:
    assert tracks_of("toy_camera_plugin:Paint") == ["detection"]
    assert tracks_of("cavbench.driving.victims.dqn:DQN") == ["driving"]
    assert tracks_of("cavbench.attacks.none:NoAttack") == ["any"]
    assert tracks_of("cavbench.detection.victims.fcos:FCOS") == ["detection"], "through a generic base class"
    assert tracks_of("nowhere:Nothing") == []
    assert {"none", "paint", "blank"} <= set(names("attack", "detection"))


def test_a_patch_is_crafted_once_a_seed_and_shown_in_every_cell(tmp_path: Path) -> None:
    records, watcher = run(tmp_path)
    attacked = records.filter(pc.field("attack") == "paint")
    assert len(crafted(watcher)) == 2
    assert {task.unit.training_seed for task in crafted(watcher)} == {0, 1}
    assert watcher.told[-1][1] == 1.0
    files = {path.stem for path in (tmp_path / "patches").iterdir()}
    assert set(attacked["patch"].to_pylist()) == files
    assert len(set(attacked["patch_sha256"].to_pylist())) == 2
    assert set(attacked["queries"].to_pylist()) == set(attacked["gradients"].to_pylist()) == {4 * 12}
    assert attacked.num_rows == 2 * 2 * 3
    assert watcher.episodes == records.num_rows


def test_a_detector_without_a_seed_is_scored_clean_once(tmp_path: Path) -> None:
    records, _ = run(tmp_path)
    clean = records.filter(pc.field("attack") == "none")
    assert clean.num_rows == 2 * 3
    assert set(clean["training_seed"].to_pylist()) == {0}
    assert set(clean["patch"].to_pylist()) == set(clean["patch_sha256"].to_pylist()) == {""}
    assert set(clean["threat_budget"].to_pylist()) == {0.0}


def test_each_scenario_seed_has_a_location_and_every_frame_is_recorded(tmp_path: Path) -> None:
    records, _ = run(tmp_path)
    for row in records.to_pylist():
        assert row["location"] == ("front", "side", "back")[row["seed"] % 3]
        assert row["frame_distance_m"] == sorted(row["frame_distance_m"], reverse=True)
        assert len(row["frame_confidence"]) == len(row["frame_visible"]) == 10
        assert row["confidence_mean"] == pytest.approx(sum(row["frame_confidence"]) / 10)


def test_every_attack_is_compared_with_baseline_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cavbench.detection.track.REFERENCE_PATCHES", ("blank", "not_installed"))
    units = read(SMALL).units()
    blank = [unit for unit in units if unit.pair.attack.name == "blank"]
    assert {unit.training_seed for unit in blank} == {0}
    assert len(blank) == 2
    assert {unit.pair.threat for unit in blank} == {units[0].pair.threat}
    assert not [unit for unit in read(f"{SMALL} reference=false").units() if unit.pair.attack.name == "blank"]
    assert {unit.pair.attack.name for unit in read(SMALL.replace("paint", "none")).units()} == {"none"}


def test_an_interrupted_run_loses_neither_patches_nor_cells(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "broken-off", watcher=Silent(stop_after=3))
    kept = {path: path.read_bytes() for path in (tmp_path / "broken-off" / "patches").iterdir()}
    assert len(kept) == 2
    went_on, watcher = run(tmp_path / "broken-off")
    assert not crafted(watcher)
    assert watcher.there == 3
    assert all(path.read_bytes() == blob for path, blob in kept.items())
    whole, _ = run(tmp_path / "whole")
    assert went_on.drop_columns(BESIDE).equals(whole.drop_columns(BESIDE))
    again, watcher = run(tmp_path / "whole")
    assert watcher.done == []
    assert again.equals(whole)


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    one, _ = run(tmp_path / "one")
    three, watcher = run(tmp_path / "three", "executor=processes", "workers=3")
    assert len(crafted(watcher)) == 2
    assert one.drop_columns(BESIDE).equals(three.drop_columns(BESIDE))


def test_scoring_and_crafting_have_separate_code_digests() -> None:
    unit = next(unit for unit in read(SMALL).units() if unit.artefact)
    scoring, crafting = (set(fingerprint.sources(modules)) for modules in (unit.modules, unit.artefact_modules))
    assert "cavbench.detection.approach" in scoring
    assert "cavbench.detection.crafting" in crafting
    assert "cavbench.detection.approach" not in crafting


@pytest.mark.parametrize(
    ("mood", "part"),
    [
        ("crooked", "a patch must be [3, P, P] with P from 8 to 512, the attack made one of [3, 7, 8]"),
        ("greedy", "the attack asked about 20004 images, the threat model allows 20000"),
        ("tamper", "the weights of the detector changed"),
        ("raise", "ZeroDivisionError: the attack is at a loss"),
    ],
)
def test_an_attack_that_breaks_the_rules_of_crafting_is_refused_in_one_line(
    tmp_path: Path, mood: str, part: str
) -> None:
    with pytest.raises(UserError) as raised:
        run(tmp_path, f"attack.mood={mood}")
    assert part in str(raised.value)
    assert f"paint(mood={mood}) + none + red | patch, seed 0" in str(raised.value)


def test_texels_are_clipped_and_their_excess_is_recorded(tmp_path: Path) -> None:
    loud, _ = run(tmp_path, "attack.mood=loud", "weather=clear")
    attacked = loud.filter(pc.field("attack") == "paint")
    assert 0 < min(attacked["excess"].to_pylist()) <= max(attacked["excess"].to_pylist()) <= 1
    with safe_open(patch_path(tmp_path, attacked["patch"][0].as_py()), "pt") as file:
        texels = file.get_tensor("patch")
    assert 0 <= float(texels.min()) < float(texels.max()) <= 1


def test_a_patch_that_must_be_printable_is_projected_and_what_is_seen_instead_is_recorded(tmp_path: Path) -> None:
    records, _ = run(tmp_path, "threat.norm=print", "weather=clear", "seeds=0")
    (attacked, clean) = (records.filter(pc.field("attack") == name) for name in ("paint", "none"))
    with safe_open(patch_path(tmp_path, attacked["patch"][0].as_py()), "pt") as file:
        texels = file.get_tensor("patch")
    assert PatchThreat(norm="print").project(texels)[1] < 1e-4
    assert min(attacked["excess"].to_pylist()) > 0.01
    assert set(attacked["threat_norm"].to_pylist()) == {"print"}
    assert attacked["non_printability"][0].as_py() == pytest.approx(float(non_printability(texels)))
    assert clean["non_printability"].null_count == clean.num_rows
    assert clean["confidence_visible"].equals(clean["confidence_mean"])
    assert (set(clean["misread"].to_pylist()), set(clean["seen_instead"].to_pylist())) == ({0.0}, {""})


def test_a_trained_detector_has_one_zoo_entry_per_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: Bench
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    said = bench("train", "victim=red", "defense=harden", "world=red_street", "seeds=0,1")
    assert said.code == 0, said.err
    assert "To use it: bench run victim=red defense=harden defense.trained_in=red_street" in said.out
    recipe = zoo.Recipe.of(component("victim", "red", {}), component("defense", "harden", {"trained_in": "red_street"}))
    assert zoo.card(recipe, 1)["scenes"] == 12
    records, watcher = run(tmp_path, "defense=harden", "defense.trained_in=red_street", "weather=clear")
    assert len(crafted(watcher)) == 2
    assert records.num_rows == 2 * 2 * 3
    assert len(set(records["weights_sha256"].to_pylist())) == 2
    with pytest.raises(UserError, match="defense 'harden' does not fit victim 'toy' of the driving track"):
        training_of(["victim=toy", "defense=harden"])


COUNT = """
def count(records, console):
    console.print({track: table.num_rows for track, table in records.items()})
"""


def test_a_folder_holds_both_tracks_and_every_command_reads_them(tmp_path: Path, plugins: Path, bench: Bench) -> None:
    install(plugins, "counting", {"cavbench.reports": {"count": "counting:count"}}, {"counting": COUNT})
    monkey = ("executor=serial", "record=0", "reference=false", f"out={tmp_path}")
    assert bench("run", *TOY, *monkey).code == 0
    made = bench("run", *SMALL.split(), *monkey)
    assert made.code == 0, made.err
    assert "18/18 episodes" in made.err
    assert "frames" in made.out
    both = reading.read_all(tmp_path)
    assert {name: set(records["victim"].to_pylist()) for name, records in both.items()} == {
        "driving": {"toy"},
        "detection": {"red"},
    }
    shown, report = bench("show", str(tmp_path)), bench("report", f"out={tmp_path}")
    one = bench("show", "paint", "--out", str(tmp_path))
    for said in (shown, report, one):
        assert said.code == 0, said.err
    assert "safe progress" in shown.out
    assert "safe progress" in report.out
    assert "safe progress" not in one.out
    assert "patch 0.5, access gradients, 20000 queries" in one.out
    rows = {track: table.num_rows for track, table in reading.read_all(tmp_path).items()}
    assert bench("report", "count", f"out={tmp_path}").out == f"{rows}\n"


def test_a_detector_that_always_says_stop_ranks_at_the_bottom(tmp_path: Path, bench: Bench) -> None:
    words = ("executor=serial", "record=0", f"out={tmp_path}", "weather=clear", "seeds=0", "victim=red,stop_everywhere")
    said = bench(
        "run", *[word for word in SMALL.split() if word.split("=")[0] not in ("victim", "weather", "seeds")], *words
    )
    assert said.code == 0, said.err
    assert "false" in said.out
    found, _ = read_boards(reading.read_all(tmp_path))
    honest, cheat = found[0].rows
    assert (honest.identity["victim"], cheat.identity["victim"]) == ("red", "stop_everywhere")
    assert honest.worst.score.estimate > cheat.worst.score.estimate == 0
    assert {flag.name for flag in cheat.flags if flag.fired} - {flag.name for flag in honest.flags if flag.fired} >= {
        "octagon",
        "ignores_input",
    }
    records = reading.read(tmp_path, track=track("detection")).filter(pc.field("victim") == "stop_everywhere")
    assert set(records["confidence_mean"].to_pylist()) == {1.0}


def test_the_file_of_a_patch_contains_its_provenance(tmp_path: Path) -> None:
    records, _ = run(tmp_path, "weather=clear", "seeds=0", "attack=paint,blank")
    kept = {
        name: Patch.read(patch_path(tmp_path, find(records, {"attack": name})["patch"]).read_bytes())
        for name in ("paint", "blank")
    }
    assert kept["blank"].evolution is None
    evolution = kept["paint"].evolution
    assert evolution is not None
    assert evolution.steps.tolist() == [0, 1, 2, 3]
    assert evolution.texels.shape == (4, 3, 8, 8)
    assert list(evolution.losses) == ["brightness", "score"]
    assert (evolution.losses["score"].diff() < 0).all()


def test_the_first_approaches_of_each_requested_pair_are_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: Bench
) -> None:
    monkeypatch.setattr("cavbench.detection.track.REFERENCE_PATCHES", ("blank",))
    said = bench("run", *SMALL.split(), "executor=serial", f"out={tmp_path}")
    assert said.code == 0, said.err
    assert "was not recorded" not in said.err
    (path,) = recordings(tmp_path, None)
    assert path.parent.name.startswith("paint-none-red-")
    assert path.name == "lanes-3-density-1-weather-clear-1000000.rrd"
    assert f"bench view {path}" in bench("show", str(tmp_path)).out
    run(tmp_path / "two", "attack=none", "record=2")
    names = {path.name.removeprefix("lanes-3-density-1-weather-") for path in recordings(tmp_path / "two", None)}
    assert names == {f"{weather}-{seed}.rrd" for weather in ("clear", "fog") for seed in (1_000_000, 1_000_001)}


def test_a_replay_reproduces_the_record_and_writes_a_recording(tmp_path: Path, bench: Bench) -> None:
    records, _ = run(tmp_path)
    record = find(records, {"attack": "paint", "location": "back"})
    again = replay(tmp_path, record)
    assert again.differences == ()
    assert recordings(tmp_path, None) == [again.path]
    said = bench("view", "paint", "weather=fog", "seed=1000001", "--out", str(tmp_path))
    assert said.code == 0, said.err
    assert "Replayed bit for bit" in said.out
    assert "lanes-3-density-1-weather-fog-1000001.rrd" in said.out.replace("\n", "")
    path = patch_path(tmp_path, record["patch"])
    path.write_bytes(path.read_bytes()[:-4])
    assert_one_line(
        bench("view", "paint", "--out", str(tmp_path), "seed=1000000"), f"the patch {path.name} is truncated"
    )
    path.unlink()
    assert_one_line(bench("view", "paint", "--out", str(tmp_path), "seed=1000000"), f"{path} is missing")


@pytest.mark.slow
def test_a_worker_that_is_killed_while_it_crafts_loses_no_patch_and_no_cell(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"ended its worker process \(SIGKILL"):
        run(tmp_path, "attack.mood=calm,kill", "executor=processes", "workers=2", "seeds=0")
    kept = set(tmp_path.glob("patches/*.safetensors"))
    records, watcher = run(tmp_path, "seeds=0")
    assert len(crafted(watcher)) == 1 - len(kept)
    assert records.num_rows == 2 * 2 * 3
