"""Our own published records, shipped with the package: one file a row of the leaderboard, and its face beside it.

    python -m cavbench.leaderboard.published RESULTS          # publishes the newest records of a results folder, row by row
    python -m cavbench.leaderboard.published RESULTS --add    # adds them to those that a row has
    python -m cavbench.leaderboard.published RESULTS --faults # adds what `attack=faults` did to rows
    python -m cavbench.leaderboard.published RESULTS --worlds # adds what `attack=worlds` did in several worlds
    python -m cavbench.leaderboard.published                  # writes the faces of all rows again

A row is a defended victim on a grid. Its records are `data/GRID/NAME.parquet`, its face is `rows/GRID/NAME.json`
(`cavbench.leaderboard.faces`). So a new row is two new files, and no other one changes. The records of all baselines of a grid,
which no leaderboard ranks, are one file, `data/GRID/baselines.parquet`. So are those of faults, of every
version of their suite: `data/faults/faults.parquet`.
Records of the suite `worlds` are read by the leaderboard over worlds alone: `data/worlds-2/NAME.parquet`, a file for all worlds.
"""

from __future__ import annotations

import argparse
import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import as_file, files
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from rich.console import Console

from cavbench.core import suites
from cavbench.core.registry import Kind
from cavbench.core.track import Track, track, tracks
from cavbench.errors import UserError
from cavbench.files import whole
from cavbench.identity.fingerprint import canonical
from cavbench.leaderboard.comparisons.comparison import DEFENDED, IDENTITY, NO_ATTACK, parameters
from cavbench.leaderboard.comparisons.reading import groups
from cavbench.leaderboard.comparisons.typed import typed
from cavbench.leaderboard.faces import write_face
from cavbench.leaderboard.ranking.faults import FAULT
from cavbench.records import reading
from cavbench.records.columns import track_of
from cavbench.records.schema import AUDIT, encoded
from cavbench.records.table import plain, together

HOME = "cavbench.leaderboard"
BASELINES = "baselines"
"""The file of a grid with the victims that others are compared with."""
FAULTS = "faults"
"""The file with the records of a suite of faults, which ranks nothing, of all rows with their controls and baselines."""
WORLDS = "worlds"
"""The family of suites whose records are compared over worlds, and rank nothing within one."""
SERIES = ("pair", "training_seed", "grid")
"""The columns that records are renewed by."""
MEASURED = frozenset({"return", "distance_m", "min_ttc_s", "mean_speed", "linf", "l2", "linf_m", "linf_mps"})
"""Columns of numbers that hardly repeat: they are stored byte by byte without a dictionary, a sixth smaller."""
TIMES = ("attack_ms", "crafting_s", "wall_s")
"""Columns of measured times. They are published with three significant digits: more are noise, and a twentieth of a file."""

SINGLE = ("linf", "l2", "linf_m", "linf_mps", "mean_speed")
"""Columns that are published in single precision, which makes a file a quarter smaller. No score is computed from them."""


def published(of: Track) -> pa.Table:
    """Every record of a track in `leaderboard/data`, an empty table if none is shipped."""
    with as_file(files(HOME) / "data") as folder:
        return _read(of, [path for path in sorted(folder.glob("*/*.parquet")) if not _is_of_worlds(path)])


def _read(of: Track, paths: Sequence[Path]) -> pa.Table:
    """The records of a track in some files."""
    tables = [reading.read_file(path) for path in paths if track_of(path).name == of.name]
    return together([encoded(of).empty_table(), *tables])


def _is_of_worlds(path: Path) -> bool:
    return path.parent.name.rpartition("-")[0] == WORLDS


def every_track(*, worlds: bool = False) -> dict[str, pa.Table]:
    """The published records of every track that has some.

    Args:
        worlds: whether those for the leaderboard over worlds (`of_worlds`) are among them.
    """
    found = {one.name: [published(one)] for one in tracks()}
    for name, records in (of_worlds() if worlds else {}).items():
        found[name].append(records)
    several = {name: together(tables) for name, tables in found.items()}
    return {name: records for name, records in several.items() if records.num_rows}


def of_worlds() -> dict[str, pa.Table]:
    """The published records for the leaderboard over worlds alone, by track; those of the newest suite."""
    with as_file(files(HOME) / "data") as folder:
        paths = sorted((folder / suites.suite(WORLDS).name).glob("*.parquet"))
        found = {one.name: _read(one, paths) for one in tracks()}
    return {name: records for name, records in found.items() if records.num_rows}


def publish(folder: Path, home: Path, *, add: bool = False) -> dict[str, int]:
    """Publish the newest records of a results folder: a file of records and a face for each row.

    Args:
        folder: what `bench run out=` was given.
        home: where `data` and `rows` are, usually the folder `leaderboard`.
        add: keep the records that a row has of all pairs, training seeds and grids of which the folder has fewer episodes.
            Those of baselines are always kept. Those from before a component got another parameter are of other pairs, and go.

    Returns:
        How many episodes each file has then, by `GRID/NAME`.

    Raises:
        UserError: if the folder has no records.
    """
    found = {}
    for track_name, records in reading.read_all(folder).items():
        for grid, defended, part in _rows(records, track(track_name)):
            file = _file(home / "data" / grid, defended)
            if file.exists() and (defended is None or (add and _defended(file) == defended)):
                part = added(reading.read_file(file), part)
            write_records(part, file)
            if defended is not None:
                write_face(file, home)
            found[f"{grid}/{file.stem}"] = int(part.num_rows)
    return found


def publish_faults(folder: Path, home: Path) -> dict[str, int]:
    """Add the records of a results folder in which `attack=faults` was driven to the published ones; as `publish`.

    Raises:
        UserError: if the folder has no records, or those of attacks.
    """
    found = {}
    for records in reading.read_all(folder).values():
        attacks = set(pc.unique(records["attack"]).to_pylist())
        if not {FAULT} <= attacks <= {FAULT, NO_ATTACK}:
            raise UserError(
                f"{folder} must have the records of attack=faults alone, and has {', '.join(sorted(attacks))}"
            )
        file = home / "data" / FAULTS / f"{FAULTS}.parquet"
        write_records(added(reading.read_file(file), records) if file.exists() else records, file)
        found[f"{file.parent.name}/{file.stem}"] = int(reading.read_file(file).num_rows)
    return found


def publish_worlds(folder: Path, home: Path) -> dict[str, int]:
    """Add the records of a results folder in which `attack=worlds` was driven to the published ones; as `publish`.

    A file has a defended victim in all worlds, wherever it was trained. A file of baselines has those of all worlds.

    Raises:
        UserError: if the folder has no records, or those of attacks that the suite does not have.
    """
    suite = suites.suite(WORLDS)
    found = {}
    for track_name, records in reading.read_all(folder).items():
        attacks = set(pc.unique(records["attack"]).to_pylist())
        if others := attacks - {member.attack for member in suite.members} - {NO_ATTACK}:
            raise UserError(
                f"{folder} must have the records of attack={WORLDS} alone, and has {', '.join(sorted(others))}"
            )
        for name, part in _by_name(records, track(track_name)).items():
            file = home / "data" / suite.name / f"{name}.parquet"
            part = added(reading.read_file(file), part) if file.exists() else part
            write_records(part, file)
            found[f"{suite.name}/{name}"] = int(part.num_rows)
    return found


def _by_name(records: pa.Table, of: Track) -> dict[str, pa.Table]:
    """The records by the name of a file: that of a defended victim, or of all baselines together."""
    found: dict[str, list[pa.Table]] = {}
    for _, defended, part in _rows(records, of):
        found.setdefault(_name(defended), []).append(part)
    return {name: pa.concat_tables(parts) for name, parts in found.items()}


def _rows(records: pa.Table, of: Track) -> Iterator[tuple[str, Mapping[str, object] | None, pa.Table]]:
    """The grid and the records of each row with what is defended; None for all baselines of a grid together.

    The records of an audit, which no score contains, are with those of the first grid of what was audited.
    """
    baselines: dict[str, list[pa.Table]] = {}
    for defended, part in groups(records, DEFENDED):
        identities = [identity for identity, _ in groups(part, IDENTITY)]
        is_baseline = all(one["attack"] == NO_ATTACK and of.baseline_of(one, one) for one in identities)
        grids = sorted({str(one["grid"]) for one in identities} - {AUDIT}) or [AUDIT]
        for place, grid in enumerate(grids):
            wanted = [grid, AUDIT] if place == 0 else [grid]
            own = part.filter(pc.is_in(part["grid"], pa.array(wanted)))
            if is_baseline:
                baselines.setdefault(grid, []).append(own)
            else:
                yield grid, defended, own
    for grid, several in baselines.items():
        yield grid, None, pa.concat_tables(several)


def _file(folder: Path, defended: Mapping[str, object] | None) -> Path:
    """Where the records of a row are: `VICTIM+DEFENCE.parquet`, with a short hash where another row has that name."""
    plain = folder / f"{_name(defended)}.parquet"
    if defended is None or not plain.exists():
        return plain
    # A parameter that came later, with its default, makes no other row.
    if _typed(_defended(plain)) == _typed(defended):
        return plain
    return plain.with_stem(f"{plain.stem}-{hashlib.sha256(canonical(defended).encode()).hexdigest()[:8]}")


def _name(defended: Mapping[str, object] | None) -> str:
    if defended is None:
        return BASELINES
    return "+".join([str(defended["victim"])] + [str(defended["defense"])] * (defended["defense"] != "none"))


def _defended(file: Path) -> Mapping[str, object]:
    """Whose records a published file of a row has."""
    return dict(pq.read_table(file, columns=list(DEFENDED)).slice(0, 1).to_pylist()[0])


def _typed(defended: Mapping[str, object]) -> list[tuple[str, dict[str, object]]]:
    """The names of what is defended, and what somebody types for each."""
    kinds: tuple[Kind, ...] = ("defense", "victim", "world")
    names = {kind: str(defended[kind]) for kind in kinds}
    return [(name, typed(kind, name, parameters(defended[f"{kind}_params"]))) for kind, name in names.items()]


def write_records(records: pa.Table, file: Path) -> None:
    """Write the records of a row: what the code says of their columns is left out, which is half of a small file."""
    records = rounded(plain(records))
    records = records.cast(pa.schema([column.remove_metadata() for column in records.schema])).combine_chunks()
    file.parent.mkdir(parents=True, exist_ok=True)
    with whole(file) as made:
        pq.write_table(
            records,
            made,
            compression="zstd",
            compression_level=19,
            use_byte_stream_split=[name for name in records.column_names if name in MEASURED],
            use_dictionary=[name for name in records.column_names if name not in MEASURED],
            write_statistics=False,
        )


def rounded(records: pa.Table) -> pa.Table:
    """The records with as many digits as are published (`TIMES`, `SINGLE`)."""
    for place, field in enumerate(records.schema):
        if field.name in TIMES:
            times = [None if one is None else float(f"{one:.3g}") for one in records[place].to_pylist()]
            records = records.set_column(place, field, [times])
        elif field.name in SINGLE:
            records = records.set_column(place, field, records[place].cast(pa.float32(), safe=False).cast(field.type))
    return records


def added(old: pa.Table, new: pa.Table) -> pa.Table:
    """Both tables; of each pair, training seed and grid, the new records count where they are not fewer."""
    tables = [old, new.select(old.column_names).cast(old.schema)]
    keys = [list(zip(*(table[name].to_pylist() for name in SERIES), strict=True)) for table in tables]
    counts = [Counter(one) for one in keys]
    renewed = {key for key, count in counts[1].items() if count >= counts[0][key]}
    of_old = pa.array([key not in renewed for key in keys[0]], pa.bool_())
    of_new = pa.array([key in renewed for key in keys[1]], pa.bool_())
    return pa.concat_tables([tables[0].filter(of_old), tables[1].filter(of_new)])


def row_files(home: Path) -> list[Path]:
    """The records of all rows; not those of baselines, faults and the leaderboard over worlds."""
    files = sorted((home / "data").glob("*/*.parquet"))
    return [path for path in files if path.stem not in (BASELINES, FAULTS) and not _is_of_worlds(path)]


def main() -> None:
    """The command of this module."""
    parser = argparse.ArgumentParser(description="Publish the newest records of a results folder, row by row.")
    parser.add_argument("folder", type=Path, nargs="?", help="results folder; without one the faces are written again")
    parser.add_argument("--add", action="store_true", help="add them to the records of the rows")
    parser.add_argument("--faults", action="store_true", help="add what attack=faults did to rows")
    parser.add_argument("--worlds", action="store_true", help="add what attack=worlds did in several worlds")
    words = parser.parse_args()
    with as_file(files(HOME)) as home:
        if words.folder is None:
            for file in row_files(home):
                write_face(file, home)
            return
        if words.faults:
            made = publish_faults(words.folder, home)
        elif words.worlds:
            made = publish_worlds(words.folder, home)
        else:
            made = publish(words.folder, home, add=words.add)
        for name, episodes in made.items():
            Console().print(f"{name}: {episodes} episodes")


if __name__ == "__main__":
    main()
