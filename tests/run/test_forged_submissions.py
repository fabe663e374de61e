"""Each value of a submission, forged: it is found and named, or it is one that the maintainer's own drive replaces."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from datetime import timedelta
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from cavbench.cli import submit as cli
from cavbench.core.track import track
from cavbench.errors import UserError
from cavbench.records import reading
from cavbench.records.schema import schema
from cavbench.run import claims, received, verification
from cavbench.terminal import Console
from tests.command import Said

Bench = Callable[..., Said]
TRACK = track("driving")
HASH = re.compile("[0-9a-f]{64}")
PAIR = "nudge-guard"
GRID = ("victim=toy", "world=toy", "lanes=3,4", "density=1", "weather=clear", "episodes=4", "seeds=0,1", "record=0")
RUN = ("run", "attack=nudge", "defense=guard", "defense.digits=2", *GRID, "executor=serial")

OWN = {"created_at", "wall_s", "machine", *verification.PROBED, *TRACK.unrepeatable}
"""Columns whose forged values need not be found: they are never taken from a submission."""


class Made:
    """Results, the submission of a pair in them, and what a drive of all its units gives."""

    def __init__(self, folder: Path) -> None:
        self.results, self.submission = folder / "results", folder / "submission"
        self.units: dict[str, Any] = {}
        self.records = pa.table({})


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return Made(tmp_path_factory.mktemp("made"))


@pytest.fixture
def made(bench: Bench, kept: Made, monkeypatch: pytest.MonkeyPatch) -> Made:
    """The submission, with a runner that has driven it before: it gives the records of the results."""
    if not kept.units:
        assert bench(*RUN, f"out={kept.results}").code == 0
        assert bench("submit", PAIR, f"results={kept.results}", f"out={kept.submission}").code == 0
        with received.received(kept.submission) as found:
            claim = claims.of(list(found.records.values()))
        kept.units = {unit.fingerprint: unit for unit in claim.plan.units()}
        kept.records = reading.read(kept.results, track=TRACK)

    def run(config: Any, watcher: object, choose: Callable[[Mapping[str, Any]], object]) -> None:
        choose(kept.units)
        shutil.copytree(kept.results, config.out, dirs_exist_ok=True)

    monkeypatch.setattr(verification.runner, "run", run)
    return kept


def verified(folder: Path, out: Path | None = None) -> tuple[int, str]:
    """The exit code of `bench verify`, and what it says."""
    words = [str(folder), "audit=false", f"out={out}" if out else "sample=all"]
    console = Console(file=open(os.devnull, "w"), record=True, width=400)  # noqa: SIM115
    try:
        code = cli.verify(words, console, lambda *row: None)
        return code, console.export_text()
    except UserError as error:
        return 2 if "\n" not in str(error) else 3, str(error)


def rehashed(folder: Path) -> None:
    """Make the description fit the files."""
    path = folder / "submission.json"
    about = json.loads(path.read_text())
    files = [
        one for one in sorted(folder.rglob("*")) if one.is_file() and one.name not in ("submission.json", "CARD.md")
    ]
    about["files"] = {one.relative_to(folder).as_posix(): hashlib.sha256(one.read_bytes()).hexdigest() for one in files}
    path.write_text(json.dumps(about))


def forged(made: Made, folder: Path, change: Callable[[pa.Table], pa.Table], every: bool = False) -> Path:
    """A copy of the submission in which the records of one unit, or of all, are changed, with hashes that fit."""
    shutil.copytree(made.submission, folder)
    for path in sorted(folder.glob("episodes/*"))[: None if every else 1]:
        records = change(pq.read_table(path))
        path.unlink()
        name = records["unit"][0].as_py() if "unit" in records.column_names else path.stem
        pq.write_table(records, path.with_name(f"{name if HASH.fullmatch(str(name)) else path.stem}.parquet"))
    rehashed(folder)
    return folder


def values(column: pa.Field, value: Any) -> Iterator[Any]:
    """Plausible forgeries of a value."""
    kind = column.type
    if column.nullable and value is not None:
        yield None
    if pa.types.is_list(kind):
        yield [*(value or []), 1]
        yield []
    elif pa.types.is_timestamp(kind):
        yield value + timedelta(seconds=1)
        yield value.replace(year=2999)
    elif pa.types.is_boolean(kind):
        yield not value
    elif pa.types.is_integer(kind):
        yield from ((value or 0) + 1, 2**40 if kind.bit_width > 32 else 0, -1)
    elif pa.types.is_floating(kind):
        yield from ((value or 0.0) + 0.125, float("nan"), 1e300)
    elif value.startswith("{"):
        yield value.replace(":", ": ", 1) + " "
        yield value[:-1] + ("," if len(value) > 2 else "") + '"more":1}'
        yield value[:-1] + ("," if len(value) > 2 else "") + '"a":1,"a":2}'
        yield "{}"
        yield "[" * 5000
    else:
        yield from (value + "x", "none", "", "0" * 64, "a\nb", "x" * 200_000)


def replaced(records: pa.Table, name: str, value: Any, rows: int) -> pa.Table:
    """The records with another value in the first rows of a column."""
    place = records.schema.get_field_index(name)
    column = records[name].to_pylist()
    column[:rows] = [value] * min(rows, len(column))
    return records.set_column(place, records.schema.field(name), pa.array(column, records.schema.field(name).type))


@pytest.mark.parametrize("column", schema(TRACK), ids=lambda column: column.name)
def test_every_forged_column_is_found_or_not_taken(column: pa.Field, made: Made, tmp_path: Path) -> None:
    before = pq.read_table(sorted(made.submission.glob("episodes/*"))[0])[column.name][0].as_py()
    number = 0
    for value in values(column, before):
        if value == before:
            continue
        for rows, every in ((1, False), (4, column.name != "unit")):
            number += 1
            change = partial(replaced, name=column.name, value=value, rows=rows)
            folder = forged(made, tmp_path / f"{number}", change, every)
            out = tmp_path / f"out{number}"
            code, said = verified(folder, out)
            if code == 0:
                assert column.name in OWN, f"{column.name} = {value!r} in {rows} rows was not found"
                taken = reading.read(out, track=TRACK)
                assert taken[column.name].equals(made.records[column.name])
            else:
                assert column.name in said, f"{column.name} = {value!r}: {said}"
                assert not list(out.glob("episodes/*"))
            shutil.rmtree(folder)
    assert number


def paths_of(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The ways to all values in JSON."""
    yield path
    for key, inner in value.items() if isinstance(value, dict) else ():
        yield from paths_of(inner, (*path, key))


def test_every_forged_value_of_the_description_is_found(made: Made, tmp_path: Path) -> None:
    folder = tmp_path / "forged"
    shutil.copytree(made.submission, folder)
    place = folder / "submission.json"
    text = place.read_text()
    assert verified(folder)[0] == 0
    for path in [path for path in paths_of(json.loads(text)) if path]:
        for change in (lambda old: None, lambda old: f"{old}x", lambda old: [old], lambda old: True, "delete", "more"):
            about = json.loads(text)
            inside = about
            for key in path[:-1]:
                inside = inside[key]
            if change == "delete":
                del inside[path[-1]]
            elif change == "more":
                inside[f"{path[-1]}x"] = inside[path[-1]]
            else:
                inside[path[-1]] = change(inside[path[-1]])  # type: ignore[operator]
            place.write_text(json.dumps(about))
            code, said = verified(folder)
            assert code == 2, (path, said)
            # The path of a file is longer than a message quotes.
            assert path[0] in said, (path, said)
    place.write_text(text)
    assert verified(folder)[0] == 0


def schema_changed(change: Callable[[pa.Table], pa.Table]) -> Callable[[Path], None]:
    """Rewrites the first file of records."""

    def forge(folder: Path) -> None:
        path = sorted(folder.glob("episodes/*"))[0]
        records = change(pq.read_table(path))
        pq.write_table(records, path)

    return forge


def doubled(records: pa.Table) -> pa.Table:
    return records.append_column(records.schema.field("crashed"), records["crashed"])


def as_float(records: pa.Table) -> pa.Table:
    place = records.schema.get_field_index("training_seed")
    return records.set_column(place, "training_seed", records["training_seed"].cast(pa.float64()))


def as_dictionary(records: pa.Table) -> pa.Table:
    place = records.schema.get_field_index("pair")
    return records.set_column(place, "pair", records["pair"].dictionary_encode())


def nan_for_null(records: pa.Table) -> pa.Table:
    return replaced(records, "assured", float("nan"), 1)


def of_other_seeds(records: pa.Table) -> pa.Table:
    place = records.schema.get_field_index("seed")
    later = pc.add(records["seed"], 500)
    return records.set_column(place, records.schema.field("seed"), later)


def of_an_audit(records: pa.Table) -> pa.Table:
    return replaced(of_other_seeds(records), "grid", "audit", 4)


def older(records: pa.Table) -> pa.Table:
    return records.drop_columns(["threat_share"])


def of_nothing(records: pa.Table) -> pa.Table:
    return records.slice(0, 0)


def of_a_file(records: pa.Table) -> pa.Table:
    return replaced(records, "victim_params", '{"path":"/etc/passwd"}', 4)


def in_the_future(records: pa.Table) -> pa.Table:
    later = [value + timedelta(days=400) for value in records["created_at"].to_pylist()]
    place = records.schema.get_field_index("created_at")
    field = records.schema.field("created_at")
    return records.set_column(place, field, pa.array(later, field.type))


def first(folder: Path) -> Path:
    return sorted(folder.glob("episodes/*"))[0]


def bomb(folder: Path) -> None:
    """A million rows in a few kilobytes."""
    records = pq.read_table(first(folder))
    pq.write_table(pa.concat_tables([records] * 5_000).combine_chunks(), first(folder), compression="zstd")


def of_one_text(records: pa.Table) -> pa.Table:
    """A text that is in the file once, and a megabyte in every row."""
    return replaced(records, "victim_params", "a" * 10**6, 4)


def many(folder: Path) -> None:
    for number in range(101):
        (folder / "episodes" / f"{number:064x}.parquet").touch()


def sparse(name: str) -> Callable[[Path], None]:
    def forge(folder: Path) -> None:
        with (folder / name).open("r+b") as file:
            file.truncate(20 * 2**30)

    return forge


def pipe(name: str) -> Callable[[Path], None]:
    def forge(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        os.mkfifo(folder / name)

    return forge


def linked(folder: Path) -> None:
    path = first(folder)
    path.rename(folder.with_name(f"{folder.name}-elsewhere"))
    path.symlink_to(folder.with_name(f"{folder.name}-elsewhere"))


def linked_folder(folder: Path) -> None:
    (folder / "episodes").rename(folder.with_name(f"{folder.name}-elsewhere"))
    (folder / "episodes").symlink_to(folder.with_name(f"{folder.name}-elsewhere"))


def described(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def forge(folder: Path) -> None:
        about = json.loads((folder / "submission.json").read_text())
        change(about)
        (folder / "submission.json").write_text(json.dumps(about))

    return forge


def weights(name: str) -> Callable[[Path], None]:
    def forge(folder: Path) -> None:
        for ending in (".safetensors", ".json"):
            path = folder / "zoo" / f"{name}{ending}"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("{}")

    return forge


KEPT, REHASHED = False, True
FORGERIES: dict[str, tuple[bool, Callable[[Path], object], str]] = {
    "a doubled column": (REHASHED, schema_changed(doubled), "has the column crashed twice"),
    "an integer as a float": (REHASHED, schema_changed(as_float), "in the column training_seed, not int64"),
    "a dictionary": (REHASHED, schema_changed(as_dictionary), "in the column pair, not string"),
    "NaN for null": (REHASHED, schema_changed(nan_for_null), "assured has a NaN"),
    "columns in another order": (
        REHASHED, schema_changed(lambda records: records.select(records.column_names[::-1])), "columns in another order",
    ),
    "an older format": (REHASHED, schema_changed(older), "has no column threat_share"),
    "other seeds": (REHASHED, schema_changed(of_other_seeds), "seed"),
    "rows in another order": (REHASHED, schema_changed(lambda records: records[::-1]), "seed"),
    "a row twice": (REHASHED, schema_changed(lambda records: pa.concat_tables([records, records[:1]])), "seed"),
    "a row less": (REHASHED, schema_changed(lambda records: records[:3]), "seed"),
    "no rows": (REHASHED, schema_changed(of_nothing), "has 0 rows"),
    "an audit": (REHASHED, schema_changed(of_an_audit), "grid"),
    "a victim that reads a file": (REHASHED, schema_changed(of_a_file), "victim_params"),
    "a date in the future": (REHASHED, schema_changed(in_the_future), "created_at"),
    "a text in every row": (REHASHED, schema_changed(of_one_text), "its 4 rows unpack to 4.0 MB, at most 1.1 MB are allowed"),
    "a bomb": (REHASHED, bomb, "has 20000 rows"),
    "a unit under another name": (
        REHASHED, lambda folder: first(folder).rename(folder / "episodes" / f"{'0' * 64}.parquet"), "a wrong unit",
    ),
    "a unit twice": (
        REHASHED, lambda folder: shutil.copy(first(folder), folder / "episodes" / f"{'0' * 64}.parquet"), "whole grid, once",
    ),
    "a unit less": (REHASHED, lambda folder: first(folder).unlink(), "whole grid, once"),
    "an extra file": (KEPT, lambda folder: shutil.copy(first(folder), folder / "episodes" / f"{'0' * 64}.parquet"), "listed"),
    "a file in a wrong place": (REHASHED, lambda folder: shutil.copy(first(folder), folder), "is not allowed"),
    "an unknown folder": (KEPT, lambda folder: (folder / "more").mkdir(), "is not allowed"),
    "too many files": (KEPT, many, "more than 100 files"),
    "a link": (KEPT, linked, "no links"),
    "a link to a folder": (KEPT, linked_folder, "no links"),
    "a sparse record": (KEPT, lambda folder: sparse(f"episodes/{first(folder).name}")(folder), "has 21.5 GB"),
    "a sparse description": (KEPT, sparse("submission.json"), "has 21.5 GB"),
    "a sparse card": (KEPT, sparse("CARD.md"), "has 21.5 GB"),
    "a pipe": (KEPT, pipe("submission.json"), "is a pipe"),
    "a pipe as a card": (KEPT, pipe("CARD.md"), "is a pipe"),
    "a deep description": (KEPT, lambda folder: (folder / "submission.json").write_text("[" * 10**6), "nested deeper"),
    "a path outside": (KEPT, described(lambda about: about["files"].update({"../x.json": "0" * 64})), "../x.json is missing"),
    "an older description": (KEPT, described(lambda about: about.update(format=1)), "its format is 1"),
    "weights that nobody loads": (REHASHED, weights("dqn-00000000/seed0"), "which the pair does not load"),
    "a name that is a path": (REHASHED, weights("../seed0"), "is not allowed"),
}  # fmt: skip


@pytest.mark.parametrize("forgery", FORGERIES)
def test_a_forged_submission_is_refused_before_anything_is_driven(
    forgery: str, made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(received, "MOST_FILES", 100)
    rehash, forge, line = FORGERIES[forgery]
    folder = tmp_path / "forged"
    shutil.copytree(made.submission, folder)
    forge(folder)
    if rehash:
        rehashed(folder)
    code, said = verified(folder, tmp_path / "out")
    assert code == 2
    assert line in said
    assert not list((tmp_path / "out").glob("episodes/*"))


def test_records_of_a_control_of_a_baseline_or_of_another_pair_are_refused(made: Made, tmp_path: Path) -> None:
    others = made.records.filter(pc.equal(made.records["attack"], "none"))
    for number, unit in enumerate(pc.unique(others["unit"]).to_pylist()[:3]):
        folder = tmp_path / f"{number}"
        shutil.copytree(made.submission, folder)
        pq.write_table(others.filter(pc.equal(others["unit"], unit)), folder / "episodes" / f"{unit}.parquet")
        rehashed(folder)
        code, said = verified(folder, tmp_path / "out")
        assert (code, "has records of the pair none-" in said) == (2, True)
        assert not list((tmp_path / "out").glob("episodes/*"))


def test_what_is_changed_while_it_is_verified_changes_nothing(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, elsewhere = tmp_path / "changing", tmp_path / "elsewhere"
    shutil.copytree(made.submission, folder)
    # Its author keeps another name of the same file.
    os.link(first(folder), elsewhere)
    checked = claims.of

    def changed(units: Any) -> Any:
        elsewhere.write_bytes(b"")
        shutil.rmtree(folder)
        return checked(units)

    monkeypatch.setattr(claims, "of", changed)
    code, said = verified(folder, tmp_path / "out")
    assert code == 0, said
    assert reading.read(tmp_path / "out", track=TRACK).num_rows == made.records.num_rows


def test_an_existing_unit_is_left_as_it_is(made: Made, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(made.results, out)
    before = {path.name: path.read_bytes() for path in out.glob("episodes/*")}
    code, said = verified(made.submission, out)
    assert (code, f"0 units that were driven here are in {out}, {len(made.units)} were there already" in said) == (
        0,
        True,
    )
    assert {path.name: path.read_bytes() for path in out.glob("episodes/*")} == before
    assert not (out / verification.STAGING / made.records["pair"][0].as_py()).exists()


def test_an_existing_unit_that_says_otherwise_is_named_and_nothing_is_added(made: Made, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "episodes").mkdir(parents=True)
    unit = pq.read_table(first(made.submission))
    path = out / "episodes" / first(made.submission).name
    score = 1.0 - unit["safe_progress"][0].as_py()
    pq.write_table(replaced(unit, "safe_progress", score, 4), path)
    before = path.read_bytes()
    code, said = verified(made.submission, out)
    assert (code, "it differs in safe_progress" in said, "nothing was added" in said) == (2, True, True)
    assert {one.name: one.read_bytes() for one in out.glob("episodes/*")} == {path.name: before}


def test_a_package_that_a_message_names_can_be_typed(made: Made, tmp_path: Path) -> None:
    forge = partial(replaced, name="attack_shipped_by", value="cavbench-toy;reboot 1.0", rows=4)
    code, said = verified(forged(made, tmp_path / "forged", forge, every=True))
    assert (code, said) == (2, "attack_shipped_by is 'cavbench-toy;reboot 1.0', which is no package with its version")


@pytest.mark.usefixtures("toy_folder")
def test_a_chain_of_defenses_is_shipped_by_all_that_ship_a_link() -> None:
    own = f"cavbench {metadata.version('cavbench')}"
    assert received._shipped_by("defense", "guard+frame_stack") == f"cavbench-toy 1.0, {own}"
    assert received._shipped_by("defense", "tracker+shield") == own
    assert received._shipped_by("defense", "guard+nowhere") == ""


def test_other_weights_do_not_stand_in_for_those_of_a_row(made: Made, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "episodes").mkdir(parents=True)
    for key in made.units:
        records = made.records.filter(pc.equal(made.records["unit"], key))
        pq.write_table(replaced(records, "weights_sha256", "0" * 64, 4), out / "episodes" / f"{key}.parquet")
    code, said = verified(made.submission, out)
    assert (code, "with other weights" in said) == (2, True)


def test_weights_that_ship_are_not_replaced(made: Made, tmp_path: Path) -> None:
    from cavbench.zoo.store import SHIPPED

    ships = next(SHIPPED.glob("*/seed0.safetensors")).relative_to(SHIPPED).with_suffix("")
    folder = tmp_path / "forged"
    shutil.copytree(made.submission, folder)
    weights(str(ships))(folder)
    rehashed(folder)
    with received.received(folder) as found:
        names = dict.fromkeys(found.about["files"])
        with pytest.raises(UserError, match="stands in for weights that ship with cavbench"):
            received.check_weights(found, names)


def test_a_sample_takes_nothing(made: Made, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="out= takes what is driven here, which must be all of it"):
        cli.verify([str(made.submission), "sample=2", f"out={tmp_path / 'out'}"], Console(), lambda *row: None)
    assert not (tmp_path / "out").exists()
