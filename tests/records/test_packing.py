"""Records of many units are packed into one file: nothing is lost and nothing counts twice, whatever happens in between."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from cavbench.core.track import Track, track
from cavbench.errors import Notice
from cavbench.records import packing, reading, store
from cavbench.records.finished import finished
from cavbench.records.schema import schema
from cavbench.records.table import plain
from cavbench.run import runner
from cavbench.run.config import plan_of
from cavbench.scenarios import Cell
from tests.command import import_path
from tests.run.test_runner import Silent, comparable

pytestmark = pytest.mark.usefixtures("toy_folder")

TRACK = track("driving")
EPISODES, FEW, COUNT = 3, 4, 10
WORDS = (
    *("attack=nudge", "victim=toy", "world=toy", "lanes=3", "density=1", "weather=clear", "seeds=0"),
    *(f"episodes={EPISODES}", "reference=false", "executor=serial", "record=0"),
)


@dataclass(frozen=True)
class Named:
    id: str


@dataclass(frozen=True)
class Wanted:
    pair: Named
    cell: Cell
    training_seed: int
    seeds: range
    track: Track = TRACK


class KilledError(BaseException):
    """The process ends here."""


@pytest.fixture(scope="module")
def unit(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> pa.Table:
    """The records of one unit."""
    out = tmp_path_factory.mktemp("one")
    units = runner.run(plan_of([*WORDS, "attack=none", f"out={out}"][1:]), Silent())
    return reading.read(out, units, track=TRACK)


@pytest.fixture
def some(unit: pa.Table) -> list[pa.Table]:
    """The records of ten units, each of another training seed."""
    return [changed(changed(unit, "unit", f"{number:064x}"), "training_seed", number) for number in range(COUNT)]


@pytest.fixture
def wanted(some: Sequence[pa.Table]) -> dict[str, Wanted]:
    """What a run asks for."""
    seeds = sorted(some[0]["seed"].to_pylist())
    found = {}
    for records in some:
        row = records.slice(0, 1).to_pylist()[0]
        named, cell = Named(row["pair"]), Cell(**json.loads(row["cell"]))
        found[row["unit"]] = Wanted(named, cell, row["training_seed"], range(seeds[0], seeds[-1] + 1))
    return found


@pytest.fixture
def folder(some: Sequence[pa.Table], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a file for each unit, which is packed by four."""
    monkeypatch.setattr(packing, "UNITS", FEW)
    store.prepare(tmp_path)
    for records in some:
        store.write(tmp_path, records)
    return tmp_path


def changed(records: pa.Table, name: str, value: object) -> pa.Table:
    place = records.schema.get_field_index(name)
    column = pa.array([value] * records.num_rows, records.schema.field(name).type)
    return records.set_column(place, records.schema.field(name), column)


def names(out: Path) -> list[str]:
    return sorted(path.name for path in (out / store.FOLDER).glob("*.parquet"))


def everything(out: Path) -> tuple[pa.Table, pa.Table]:
    measured = {field.name for field in TRACK.measurements if not pa.types.is_list(field.type)}
    return reading.read(out, track=TRACK), plain(reading.read_all(out, measured)["driving"])


def test_packed_records_are_read_as_before(folder: Path, wanted: dict[str, Wanted]) -> None:
    before = everything(folder)
    packing.pack(folder)
    assert len(names(folder)) == COUNT // FEW + COUNT % FEW
    assert len(packing.packed_files(folder)) == COUNT // FEW
    after = everything(folder)
    assert after[0].equals(before[0])
    assert after[1].to_pylist() == before[1].to_pylist()
    assert finished(folder, wanted) == set(wanted)
    for key in wanted:
        own = reading.read(folder, [key], track=TRACK)
        assert own.equals(before[0].filter(pc.equal(before[0]["unit"], key)))
    assert pq.read_schema(packing.packed_files(folder)[0]).equals(schema(TRACK))


def test_units_that_finish_together_are_written_to_one_file(
    some: Sequence[pa.Table], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wanted: dict[str, Wanted]
) -> None:
    monkeypatch.setattr(store, "TOGETHER", FEW)
    store.prepare(tmp_path)
    store.write_all(tmp_path, some[: FEW - 1])
    assert len(names(tmp_path)) == FEW - 1
    store.write_all(tmp_path, some[FEW - 1 :])
    assert len(names(tmp_path)) == FEW
    assert finished(tmp_path, wanted) == set(wanted)


def test_a_kill_at_any_moment_of_a_packing_loses_nothing_and_counts_nothing_twice(
    folder: Path, wanted: dict[str, Wanted], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every operation that changes the folder is the last one once; each time the next packing goes on from there."""
    before = everything(folder)[0]
    originals = os.replace, Path.unlink
    moments = 0
    while True:
        left = [moments]

        def countdown(what: Callable[..., object], left: list[int] = left) -> Callable[..., object]:
            def operation(*words: object, **more: object) -> object:
                if not left[0]:
                    raise KilledError
                left[0] -= 1
                return what(*words, **more)

            return operation

        monkeypatch.setattr(os, "replace", countdown(originals[0]))
        monkeypatch.setattr(Path, "unlink", countdown(originals[1]))
        try:
            packing.pack(folder)
        except KilledError:
            moments += 1
        else:
            break
        finally:
            monkeypatch.setattr(os, "replace", originals[0])
            monkeypatch.setattr(Path, "unlink", originals[1])
        assert everything(folder)[0].equals(before)
        assert everything(folder)[1].num_rows == before.num_rows
        assert finished(folder, wanted) == set(wanted)
    assert moments >= FEW
    assert len(names(folder)) < COUNT


def test_a_damaged_unit_in_a_packed_file_is_driven_again_and_the_others_are_kept(
    folder: Path, wanted: dict[str, Wanted]
) -> None:
    before = everything(folder)[0]
    packing.pack(folder)
    path = packing.packed_files(folder)[0]
    records = pq.read_table(path)
    bad, short, *good = packing.units_in(path)
    impossible = changed(records.filter(pc.equal(records["unit"], bad)), "return", float("nan"))
    rest = [records.filter(pc.equal(records["unit"], key)) for key in (short, *good)]
    content = pa.concat_tables([impossible, rest[0].slice(1), *rest[1:]])
    pq.write_table(content, path)
    with pytest.warns(Notice) as told:
        assert finished(folder, wanted) == set(wanted) - {bad, short}
    said = [str(one.message) for one in told]
    assert any(f"unit {bad} in the record {path} does not count as finished: return must be" in line for line in said)
    assert any(f"unit {short} in the record {path} does not count as finished: it has 2 rows" in line for line in said)
    assert pq.read_table(folder / "set_aside" / path.name).num_rows == content.num_rows
    left = everything(folder)[0]
    lost = before.filter(pc.is_in(before["unit"], pa.array([bad, short])))
    assert left.num_rows == before.num_rows - lost.num_rows
    for key in (bad, short):
        store.write(folder, lost.filter(pc.equal(lost["unit"], key)))
    assert everything(folder)[0].equals(before)


def test_a_truncated_packed_file_is_set_aside(folder: Path, wanted: dict[str, Wanted]) -> None:
    packing.pack(folder)
    path = packing.packed_files(folder)[0]
    inside = packing.units_in(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.warns(Notice, match="is truncated or not Parquet; its units are driven again"):
        assert finished(folder, wanted) == set(wanted) - inside
    assert everything(folder)[0].num_rows == EPISODES * (COUNT - FEW)


def test_a_folder_that_is_packed_while_it_is_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = everything(folder)[0]
    check = reading.track_of

    def packs(*words: object, **more: object) -> object:
        packing.pack(folder)
        return check(*words, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(reading, "track_of", packs)
    assert reading.read(folder, track=TRACK).equals(before)


def test_a_file_that_is_not_what_its_name_says_is_not_packed(folder: Path, some: Sequence[pa.Table]) -> None:
    first, second, third = (store.path_of(folder, records["unit"][0].as_py()) for records in some[:3])
    second.write_bytes(first.read_bytes())
    third.write_bytes(b"PAR1")
    packing.pack(folder)
    assert second.exists()
    assert third.read_bytes() == b"PAR1"
    assert len(packing.packed_files(folder)) == (COUNT - 2) // FEW


def test_units_are_copied_out_of_a_packed_file(folder: Path, tmp_path: Path, some: Sequence[pa.Table]) -> None:
    packing.pack(folder)
    store.prepare(tmp_path / "copy")
    keys = [records["unit"][0].as_py() for records in some]
    packing.copy(folder, keys, tmp_path / "copy")
    assert names(tmp_path / "copy") == [f"{key}.parquet" for key in sorted(keys)]
    assert everything(tmp_path / "copy")[0].equals(everything(folder)[0])


PACKING = """
import sys
from cavbench.records import packing
packing.UNITS = 3
from cavbench.cli.main import main
sys.argv = ["bench", *sys.argv[1:]]
main()
"""
RUN = (
    *("run", "attack=nudge", "victim=toy", "world=toy", "lanes=3,4,5", "density=1,2", "weather=clear,fog", "seeds=0,1"),
    *("episodes=2", "reference=false", "executor=serial", "record=0", "attack.pause=0.01"),
)


def packing_run(folder: Path, out: Path) -> subprocess.Popen[str]:
    environment = os.environ | {"PYTHONPATH": import_path(folder), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", PACKING, *RUN, f"out={out}"]
    return subprocess.Popen(command, env=environment, text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


@pytest.mark.slow
def test_two_runs_that_pack_one_folder_and_a_kill_end_with_every_unit_once(
    toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "results"
    first, second = packing_run(toy_folder, out), packing_run(toy_folder, out)
    until = time.monotonic() + 120
    while not packing.packed_files(out):
        assert first.poll() is None, first.communicate()
        assert time.monotonic() < until
        time.sleep(0.005)
    first.kill()
    first.communicate()
    _, err = second.communicate(timeout=120)
    assert second.returncode == 0, err
    monkeypatch.setattr(packing, "UNITS", 3)
    runner.run(plan_of([*RUN[1:], f"out={out}"]), Silent())
    config = plan_of([*RUN[1:], f"out={tmp_path / 'whole'}"])
    keys = {one.fingerprint: one for one in config.units()}
    assert finished(out, keys) == set(keys)
    assert len(names(out)) < len(keys)
    runner.run(config, Silent())
    driven = reading.read(out, track=TRACK)
    assert comparable(driven).equals(comparable(reading.read(tmp_path / "whole", track=TRACK)))
