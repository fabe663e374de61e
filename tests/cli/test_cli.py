"""The command line: its output, and one line with a non-zero exit code for bad input."""

from __future__ import annotations

import re
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from cavbench.core import registry
from cavbench.core.registry import GROUPS, KINDS
from cavbench.core.track import track
from cavbench.records import reading
from tests.command import Said, ran, started
from tests.run.test_runner import comparable

Bench = Callable[..., Said]
TOY = ("attack=nudge", "victim=toy", "world=toy", "lanes=3", "density=1", "weather=clear", "episodes=4", "seeds=0")


def assert_one_line(said: Said, *parts: str) -> None:
    assert said.code != 0
    lines = said.err.strip().splitlines()
    assert len(lines) == 1, said.err
    assert lines[0].startswith("error: ")
    for part in parts:
        assert part in lines[0]


def test_a_component_is_listed_with_description_and_parameters(bench: Bench) -> None:
    said = bench("list", "nudge")
    assert said.code == 0
    for part in (
        "toy_plugin:Nudge, cavbench-toy 1.0",
        "Moves every value by the radius with a random sign.",
        "Track: driving. Needs access oblivious and discrete or continuous actions.",
        "attack.pause",
        "0.0",
        "seconds to sleep at every step.",
        "one of calm, raise, kill",
    ):
        assert part in said.out


def test_a_name_of_two_kinds_has_two_pages(bench: Bench) -> None:
    said = bench("list", "none")
    assert "attack none" in said.out
    assert "defense none" in said.out


@pytest.mark.parametrize("name", sorted({name for kind in KINDS for name in registry.entries(GROUPS[kind])}))
def test_a_components_page_fits_a_terminal_of_80_columns(
    name: str, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    said = bench("list", name)
    assert said.code == 0
    assert max(map(len, said.out.splitlines())) <= 80
    assert "…" not in said.out  # a column too narrow for its words


def test_an_unknown_component_has_no_page(bench: Bench) -> None:
    assert_one_line(bench("list", "nugde"), "unknown component 'nugde'; did you mean 'nudge'?", "known: acc, advtrain")


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("shwo",), "unknown command 'shwo'; did you mean 'show'? known: audit, certify, check"),
        (("list", "--jsn"), "unknown option '--jsn'; known: --json"),
        (("list", "a", "b"), "cannot read b: `bench list --help` says what it takes"),
        (("verify",), "FOLDER is missing; `bench verify --help` says what it is"),
        (("show", "--out"), "option --out needs a value"),
        (
            ("report", "html=/dev/null/page.html"),
            "the folder of the page /dev/null cannot be written: File exists; choose another with html=",
        ),
    ],
)
def test_what_is_typed_wrong_is_said_in_our_own_words(bench: Bench, words: tuple[str, ...], part: str) -> None:
    assert_one_line(bench(*words), part)


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("attack=nugde",), "unknown attack 'nugde'; did you mean 'nudge'?"),
        (("attack=nudge", "attack.pause=long"), "attack.pause must be a number, got long"),
        (("threat.budget=-1",), "threat.budget must be between 0 and 2, got -1"),
        (("attack=veer", "victim=toy"), "attack 'veer' does not fit victim 'toy'"),
        (("--fast",), "unknown option '--fast'; known: "),
    ],
)
def test_bad_input_is_refused_before_any_work(bench: Bench, tmp_path: Path, words: tuple[str, ...], part: str) -> None:
    assert_one_line(bench("run", *words, f"out={tmp_path / 'out'}"), part)
    assert not (tmp_path / "out").exists()


def test_a_results_folder_that_cannot_be_written_is_refused(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert_one_line(bench("run", *TOY, f"out={tmp_path / 'file' / 'out'}"), "cannot be written", "out=")


def test_a_repeated_run_only_prints_the_table(bench: Bench, tmp_path: Path) -> None:
    words = ("run", *TOY, "executor=serial", "record=0", f"out={tmp_path}")
    first, again = bench(*words), bench(*words)
    assert (first.code, again.code) == (0, 0), first.err
    assert "nudge" in first.out
    assert first.out == again.out
    assert "36/36 episodes" in first.err
    assert again.err.strip() == "36 of 36 episodes are already done"


def test_a_truncated_record_stops_what_reads_it_and_is_driven_again(bench: Bench, tmp_path: Path) -> None:
    run = ("run", *TOY, "executor=serial", "record=0", "reference=false", f"out={tmp_path}")
    bench(*run)
    path = sorted((tmp_path / "episodes").glob("*.parquet"))[0]
    path.write_bytes(path.read_bytes()[:100])
    for words in (("show", str(tmp_path)), ("report", f"out={tmp_path}")):
        assert_one_line(bench(*words), f"the record {path} is truncated")
    again = bench(*run)
    assert again.code == 0
    assert [one.name for one in (tmp_path / "set_aside").iterdir()] == [path.name]
    assert bench("report", f"out={tmp_path}").code == 0


def test_show_prints_the_provenance_of_the_records(bench: Bench, tmp_path: Path) -> None:
    bench("run", *TOY, "executor=serial", "record=0", "attack.scale=0.5", f"out={tmp_path}")
    whole = bench("show", str(tmp_path))
    pair = next(line for line in whole.out.splitlines() if line.startswith("nudge-none-toy-")).strip()
    one = bench("show", "nudge", "--out", str(tmp_path))
    for said in (whole, one):
        assert said.code == 0
        for part in (pair, "nudge(mood=calm, pause=0.0, scale=0.5)  cavbench-toy 1.0", "relative 0.1", "torch "):
            assert part in said.out
    assert_one_line(bench("show", "nothing", "--out", str(tmp_path)), "unknown pair 'nothing'", pair)
    assert_one_line(bench("show", "no/where", "--out", str(tmp_path)), "there is no folder no/where")


def test_report_prints_a_report_by_name(bench: Bench, tmp_path: Path) -> None:
    bench("run", *TOY, "executor=serial", "record=0", f"out={tmp_path}")
    assert "nudge" in bench("report", f"out={tmp_path}").out
    assert_one_line(bench("report", "theses", f"out={tmp_path}"), "unknown report 'theses'; did you mean 'thesis'?")
    assert_one_line(bench("report", f"out={tmp_path / 'none'}"), "there are no records")


def test_a_report_without_a_folder_says_which_records_it_shows(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert bench("report", "leaderboard").out.startswith("published records")
    bench("run", *TOY, "executor=serial", "record=0", "out=results")
    assert bench("report").out.startswith("records of the folder results")


def test_training_saves_to_the_zoo_and_says_how_long_it_took(bench: Bench, tmp_path: Path) -> None:
    said = bench("train", "victim=toy", "world=toy", "seeds=0,1", f"out={tmp_path}")
    assert said.code == 0
    assert len(re.findall(r"trained in \d+ s, saved as", said.out)) == 2
    (folder,) = tmp_path.iterdir()
    assert folder.name.startswith("toy-discrete-")
    assert sorted(path.name for path in folder.glob("*.safetensors")) == ["seed0.safetensors", "seed1.safetensors"]
    assert "To use it: bench run victim=toy victim.trained_in=toy" in said.out


def test_a_zoo_that_cannot_be_written_is_refused_before_the_training(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "afile").write_text("")
    said = bench("train", "victim=toy", "world=toy", f"out={tmp_path / 'afile'}")
    assert_one_line(said, "cannot be written")


def test_trained_in_must_be_the_world_of_the_training(bench: Bench, tmp_path: Path) -> None:
    said = bench("train", "victim=toy", "world=toy", "victim.trained_in=elsewhere", f"out={tmp_path}")
    assert_one_line(said, "victim.trained_in=elsewhere is not the world of this training, toy")


def test_a_victim_that_does_not_learn_cannot_be_trained(bench: Bench) -> None:
    assert_one_line(bench("train", "victim=idm"), "there is nothing to train")
    assert_one_line(bench("train", "victim=toy", "defense=guard", "defense.digits=1"), "there is nothing to train")


def test_without_a_display_view_says_how_to_open_a_recording(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "some.rrd"
    path.write_bytes(b"")
    assert f"rerun {path}" in bench("view", str(path)).out
    assert_one_line(bench("view", str(tmp_path / "other.rrd")), "there is no recording")


def test_debug_shows_the_traceback(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    from cavbench.cli import main as cli
    from cavbench.errors import UserError

    monkeypatch.setattr(sys, "argv", ["bench", "run", "attack=nugde", "--debug"])
    with pytest.raises(UserError):
        cli.main()


@pytest.mark.slow
def test_the_console_script_ends_bad_input_in_one_line(toy_folder: Path, tmp_path: Path) -> None:
    assert_one_line(ran(toy_folder, "run", "attack=nugde", f"out={tmp_path}"), "unknown attack 'nugde'")


@pytest.mark.slow
def test_kill_9_loses_no_finished_unit_and_the_same_command_continues(
    bench: Bench, toy_folder: Path, tmp_path: Path
) -> None:
    def words(out: Path) -> tuple[str, ...]:
        more = ("workers=2", "reference=false", "record=0", "attack.pause=0.05", "lanes=3,4", "seeds=0,1,2")
        return ("run", *(word for word in TOY if word[:5] not in ("lanes", "seeds")), *more, f"out={out}")

    broken, whole = tmp_path / "broken", tmp_path / "whole"
    process = started(toy_folder, *words(broken))
    until = time.monotonic() + 240
    while len(list(broken.glob("episodes/*.parquet"))) < 3:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.02)
    children = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    _, alive = psutil.wait_procs(children, timeout=60)
    assert not alive, "workers outlive the run"

    finished = {path: path.read_bytes() for path in broken.glob("episodes/*.parquet")}
    assert 3 <= len(finished) < 12
    said = ran(toy_folder, *words(broken))
    assert said.code == 0, said.err
    assert f"{4 * len(finished)} of 48 episodes are already done" in said.err
    assert all(path.read_bytes() == blob for path, blob in finished.items())
    assert bench(*words(whole)).code == 0
    driving = track("driving")
    assert comparable(reading.read(broken, track=driving)).equals(comparable(reading.read(whole, track=driving)))


@pytest.mark.slow
def test_ctrl_c_ends_a_run_in_one_line_and_with_its_workers(toy_folder: Path, tmp_path: Path) -> None:
    words = (*TOY, "attack.pause=0,600", "workers=2", "reference=false", "record=0", f"out={tmp_path}")
    process = started(toy_folder, "run", *words)
    until = time.monotonic() + 240
    while len(list(tmp_path.glob("episodes/*.parquet"))) < 1:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.02)
    children = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode != 0
    assert err.strip().splitlines()[-1].startswith("error: interrupted; ")
    assert "Traceback" not in err
    assert not psutil.wait_procs(children, timeout=60)[1]
    assert reading.read(tmp_path, track=track("driving")).num_rows


@pytest.mark.slow
@pytest.mark.parametrize("command", ["run", "report"])
def test_kill_9_leaves_no_process_and_no_temporary_file(toy_folder: Path, tmp_path: Path, command: str) -> None:
    run = ("run", *TOY, "attack.pause=600", "workers=2", "reference=false", "record=0", f"out={tmp_path}")
    words = run if command == "run" else ("report", f"html={tmp_path / 'page.html'}")
    process = started(toy_folder, *words)
    started_by = psutil.Process(process.pid)
    until = time.monotonic() + 240
    # A run has a fork server with two workers, a report one worker; each has Python's own tracker of resources, too.
    while len(children := started_by.children(recursive=True)) < {"run": 4, "report": 2}[command]:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.02)
    process.kill()
    process.communicate(timeout=60)
    assert not psutil.wait_procs(children, timeout=60)[1]
    assert not list(tmp_path.rglob(".*.tmp"))
