"""Plug-ins that misbehave while a unit is driven or while they are imported: named with their package, others are unharmed."""

from __future__ import annotations

import re
import typing
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pytest

from cavbench.core.track import track
from cavbench.records import reading
from tests.command import Said, ran
from tests.plugins.distributions import install, install_toy
from tests.tree import PLUGINS

CELL = ("world=toy", "lanes=3", "density=1", "weather=clear", "episodes=2", "seeds=0", "record=0", "reference=false")
ON_IMPORT = {
    "import_exit": "import sys; sys.exit(0)",
    "import_os_exit": "import os; os._exit(0)",
    "import_segfault": "import ctypes; ctypes.string_at(0)",
    "import_patch": "import torch; torch.Tensor.tanh = lambda tensor: tensor",
    "import_interrupt": "raise KeyboardInterrupt",
    "import_floors": "from cavbench.envs.highway import config as c; object.__setattr__(c.STANDARD_FEATURES, 'floors', (0,) * 4)",
    "import_recursion": "import inspect, sys; sys.setrecursionlimit(len(inspect.stack()) + 30)",
    "import_closed": "import os; os.closerange(3, 4096)",
    "import_thread": "import threading, time; threading.Thread(target=time.sleep, args=(600,)).start()",
    "import_dtype": "import torch; torch.set_default_dtype(torch.float64)",
}
PACKAGE = r"of cavbench-rogue 3.1"
DEEDS = {
    "system exit": "SystemExit: 0",
    "interrupt": "KeyboardInterrupt",
    "generator exit": "GeneratorExit",
    "os exit": "it ended its worker process (exit code 0)",
    "segfault": "it ended its worker process (SIGSEGV)",
    "hang": "it took longer than unit_timeout=10 seconds",
    "leak": "it used",
    "leak in a session": "it used",
    "leak in memory files": "it used",
    "leak in temporary files": "it used",
    "memory error": "MemoryError",
    "nan": "Rogue.perturb returned numbers that are NaN or infinite",
    "shape": "Rogue.perturb returned shape (2, 2, 1)",
    "weights": "is refused: ",
    "greedy": "asked for 3 queries in a step, the threat model allows 2",
    "limit": "Too many open files",
    "unprintable": "failed: UnprintableError",
    "patch torch": "is refused: torch.Tensor.tanh was replaced",
    "patch bench": "is refused: cavbench.driving.meter.Meter.columns was replaced",
}
"""What the line says about each deed that fails a unit."""
HARMLESS = ("none", "reseed", "print", "print much", "fork", "fork and stay", "leave a thread")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy distribution and the misbehaving one, on the import path of new processes only."""
    folder = tmp_path_factory.mktemp("site")
    install_toy(folder)
    points = {
        "cavbench.attacks": {"rogue": "rogue:Rogue", **{name: f"{name}:Attack" for name in ON_IMPORT}},
        "cavbench.victims": {"bad_answers": "rogue:BadVictim"},
    }
    modules = {"rogue": (PLUGINS / "misbehaving.py").read_text(), **ON_IMPORT}
    install(folder, "cavbench-rogue", points, modules, "3.1")
    return folder


@pytest.fixture(scope="module")
def swept(site: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Said, Path]:
    """One sweep over every deed, in two workers."""
    out = tmp_path_factory.mktemp("swept")
    deeds = ",".join([f"'{deed}'" for deed in (*HARMLESS, *DEEDS)])
    attacks = ",".join(["rogue", "noise", *ON_IMPORT])
    limits = ("unit_timeout=10", "unit_memory=1.5", "threat.queries=2")
    words = (f"attack={attacks}", f"attack.deed={deeds}", "victim=toy", "workers=2", *limits, *CELL)
    return ran(site, "run", *words, f"out={out}"), out


@pytest.mark.slow
def test_a_sweep_goes_on_and_names_whatever_fails_with_its_package(swept: tuple[Said, Path]) -> None:
    said, _ = swept
    assert said.code == 2
    errors = [line for line in said.err.splitlines() if line.startswith("error: ")]
    assert (
        errors[-1]
        == f"error: {len(DEEDS)} of {len(DEEDS) + len(HARMLESS) + 2} units are not finished, the others are kept"
    )
    assert len(errors) == len(ON_IMPORT) + len(DEEDS) + 1
    for deed, why in DEEDS.items():
        (line,) = (line for line in errors if f"rogue(deed={deed})" in line)
        assert why in line
        assert PACKAGE in line
    assert "Traceback" not in said.err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("import_exit", "cannot be imported: SystemExit: 0"),
        ("import_os_exit", "cannot be imported: its import ends the process (exit code 0)"),
        ("import_segfault", "cannot be imported: its import ends the process (SIGSEGV)"),
        ("import_patch", "cannot be imported: its import replaces torch.Tensor.tanh"),
        ("import_interrupt", "cannot be imported: KeyboardInterrupt"),
        (
            "import_floors",
            "cannot be imported: its import replaces cavbench.envs.highway.config.STANDARD_FEATURES.floors",
        ),
        ("import_recursion", "cannot be imported: its import changes the recursion limit"),
        ("import_closed", "cannot be imported: its import closes files of the process"),
        ("import_thread", "cannot be imported: its import changes the threads that hold the end of the process"),
        ("import_dtype", "cannot be imported: its import changes the default type of torch"),
    ],
)
def test_a_plugin_that_misbehaves_on_import_is_left_out(swept: tuple[Said, Path], name: str, why: str) -> None:
    said, _ = swept
    (line,) = (line for line in said.err.splitlines() if line.startswith(f"error: attack '{name}'"))
    assert why in line
    assert PACKAGE in line


@pytest.mark.slow
def test_the_records_of_the_others_are_unharmed(site: Path, swept: tuple[Said, Path], tmp_path: Path) -> None:
    _, out = swept
    alone = ran(site, "run", "attack=noise,rogue", "threat.queries=2", "victim=toy", *CELL, f"out={tmp_path}")
    assert alone.code == 0, alone.err
    expected, found = (reading.read(folder, track=track("driving")) for folder in (tmp_path, out))
    for pair in set(expected["pair"].to_pylist()):
        same = [comparable(records.filter(pc.equal(records["pair"], pair))) for records in (expected, found)]
        assert same[0].equals(same[1])
    # An attack that reseeds the generators, or prints, scores as the one that does neither.
    scores = {
        tuple(found.filter(pc.equal(found["pair"], pair))["safe_progress"].to_pylist())
        for pair in set(found["pair"].to_pylist())
        if pair.startswith("rogue")
    }
    assert len(scores) == 1
    assert len([pair for pair in set(found["pair"].to_pylist()) if pair.startswith("rogue")]) == len(HARMLESS)


@pytest.mark.slow
def test_what_components_print_does_not_reach_the_table(swept: tuple[Said, Path]) -> None:
    said, _ = swept
    assert "from" not in said.out
    for line in ("hello from rogue", "and from below", "complaint"):
        assert f"clear, seed 0 prints: {line}" in said.err


@pytest.mark.slow
def test_copies_of_a_worker_do_no_work_and_end_with_it(swept: tuple[Said, Path]) -> None:
    said, _ = swept
    copies = re.findall(r"prints: copy (\d+)", said.err)
    assert copies
    for copy in copies:
        state = Path(f"/proc/{copy}/stat")
        # One that ended may wait for its end to be read.
        assert not state.exists() or state.read_text().rpartition(") ")[2].startswith("Z")


@pytest.mark.slow
def test_a_process_in_a_session_of_its_own_ends_with_the_worker(swept: tuple[Said, Path]) -> None:
    said, _ = swept
    orphans = re.findall(r"prints: orphan (\d+)", said.err)
    assert orphans
    assert not any(Path(f"/proc/{orphan}").exists() for orphan in orphans)


@pytest.mark.slow
def test_a_victim_that_cannot_answer_is_named_and_drives_nothing(site: Path, tmp_path: Path) -> None:
    words = ("victim=toy,bad_answers", "victim.answer=nan,shape", *CELL)
    said = ran(site, "run", "attack=none", *words, "executor=serial", f"out={tmp_path}")
    assert said.code == 2
    asked = re.search(
        r"is refused: it answers NaN or infinity on observations of this world \(victim 'bad_answers' (.*)", said.err
    )
    assert asked
    assert asked[1].startswith(PACKAGE)
    assert "is refused: it has 2 actions, the world has 5: LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER" in said.err
    assert set(reading.read(tmp_path, track=track("driving"))["victim"].to_pylist()) == {"toy"}


@pytest.mark.slow
def test_one_process_alone_survives_what_can_be_survived(site: Path, tmp_path: Path) -> None:
    deeds = "none,'system exit',interrupt,unprintable,hang,'patch torch'"
    words = (f"attack.deed={deeds}", "victim=toy", *CELL, "executor=serial", "unit_timeout=10", f"out={tmp_path}")
    said = ran(site, "run", "attack=rogue", *words)
    assert said.code == 2
    for why in (
        "SystemExit: 0",
        "KeyboardInterrupt",
        "failed: UnprintableError",
        "unit_timeout=10",
        "torch.Tensor.tanh was replaced",
    ):
        assert why in said.err
    # After a patch nothing else can be trusted in this process.
    assert "changed this process; use executor=processes" in said.err
    assert "error: 6 of 7 units are not finished, the others are kept" in said.err


def comparable(records: pa.Table) -> pa.Table:
    beside = [field.name for field in track("driving").probes]
    return records.drop_columns(["attack_ms", "created_at", "wall_s", *beside])


def test_every_deed_is_expected_to_fail_or_to_be_harmless() -> None:
    import ast

    tree = ast.parse((PLUGINS / "misbehaving.py").read_text())
    (deeds,) = (
        typing.cast("ast.Subscript", node.value).slice
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == "Deed"
    )
    assert set(ast.literal_eval(deeds)) == {*HARMLESS, *DEEDS}
