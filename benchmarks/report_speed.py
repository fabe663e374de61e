"""Measures `bench report html=PAGE` on many records: time, memory and size of the page.

    python benchmarks/report_speed.py                      # in one file, packed as `bench run` does, a file for each unit
    python benchmarks/report_speed.py --units 10000 --rounds 3
    python benchmarks/report_speed.py --units 100000 --episodes 10 --packed --rounds 1

The three are measured in turns; the ratios are of CPU time, each to one file in the same round, and their median. The records are
synthetic: measurements are random, and provenance texts are as long as in real records. The time of the packing is printed, too.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cavbench.core.contracts import Facts
from cavbench.core.track import Track, track
from cavbench.envs.highway.axes import STANDARD_V2
from cavbench.records import packing, store
from cavbench.records.finished import finished
from cavbench.records.schema import schema
from cavbench.scenarios import Cell
from cavbench.statistics.episodes import as_text

SEEDS, ATTACKS = 3, 8
ROW_GROUP = 100_000
SCHEMA = schema(track("driving"))
FACTS = json.dumps(Facts(axes=STANDARD_V2.axes, decision_hz=15, max_steps=450).written())
POLICY = {f"parameter_{number}": 0.125 for number in range(15)}
MEASURE = """
import resource, subprocess, sys, time
start = time.perf_counter()
code = subprocess.run([sys.executable, "-m", "cavbench", "report", *sys.argv[1:]], stdout=subprocess.DEVNULL).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(code, time.perf_counter() - start, used.ru_utime + used.ru_stime, used.ru_maxrss / 1e6)
"""


def table(first: int, named: Sequence[tuple[str, str, int, Cell]], episodes: int, rng: np.random.Generator) -> pa.Table:
    """The records of some units of work, one after the other.

    Args:
        first: number of the first unit.
        named: defence, attack, training seed and cell of each.
        episodes: of a unit.
        rng: draws the measurements.
    """
    rows = [_constants(number, *one) for number, one in enumerate(named, first)]
    of_unit, count = pa.array(np.repeat(np.arange(len(rows)), episodes)), len(rows) * episodes
    measured: dict[str, object] = {
        "seed": np.tile(1_000_000 + np.arange(episodes), len(rows)),
        "crashed": rng.random(count) < 0.3,
        "offroad": np.zeros(count, bool),
        "steps": rng.integers(30, 450, count),
        "entropy": rng.integers(0, 2**62, count),
        "action_counts": rng.integers(0, 100, (count, 5)).tolist(),
    }
    columns = []
    for field in SCHEMA:
        if field.name in measured:
            columns.append(pa.array(measured[field.name], field.type))
        elif field.name in rows[0] or pa.types.is_string(field.type):
            columns.append(pa.array([row.get(field.name, "") for row in rows], field.type).take(of_unit))
        else:
            columns.append(pa.array(rng.random(count), field.type))
    return pa.table(columns, schema=SCHEMA)


def _constants(number: int, defense: str, attack: str, seed: int, cell: Cell) -> dict[str, object]:
    """What all records of a unit share."""
    clean = attack == "none"
    return {
        "unit": hashlib.sha256(str(number).encode()).hexdigest(),
        "pair": f"{attack}-{defense}-dqn-{hashlib.sha256((attack + defense).encode()).hexdigest()[:8]}",
        "attack": attack,
        "attack_params": json.dumps({} if clean else POLICY),
        "defense": defense,
        "defense_params": json.dumps(POLICY),
        "victim": "dqn",
        "victim_params": json.dumps(POLICY),
        "world": "highway",
        "world_params": "{}",
        "action_type": "discrete",
        "sees": True,
        "training_seed": seed,
        "threat_norm": "relative",
        "threat_budget": 0.0 if clean else 0.1,
        "threat_access": "oblivious" if clean else "gradients",
        "threat_queries": 0 if clean else 1000,
        "threat_share": 1.0,
        "grid": "standard-v2",
        "cell": as_text(cell),
        "world_facts": FACTS,
        "attack_shipped_by": "cavbench 0.1.0",
        "weights_sha256": hashlib.sha256(f"{defense}{seed}".encode()).hexdigest(),
        "code_digest": hashlib.sha256(attack.encode()).hexdigest(),
        "libraries": json.dumps({"python": "3.11", "torch": "2.13.0", "torchrl": "0.14.1", "numpy": "2.4.6"}),
        "machine": f"Linux x86_64, machine {number % 4}, 2 cores",
        "created_at": datetime(2026, 1, 1, tzinfo=UTC),
        "wall_s": 12.5,
    }


def named(count: int) -> Iterator[tuple[str, str, int, Cell]]:
    """Defence, attack, training seed and cell of so many units."""
    attacks = ["none", *(f"attack_{number}" for number in range(ATTACKS))]
    of_victim = list(itertools.product(attacks, range(SEEDS), STANDARD_V2.cells()))
    for number in range(count):
        yield (f"defense_{number // len(of_victim)}", *of_victim[number % len(of_victim)])


def tables(count: int, episodes: int, at_once: int) -> Iterator[pa.Table]:
    """The records of so many units, `at_once` units in a table."""
    rng, every = np.random.default_rng(0), named(count)
    for first in range(0, count, at_once):
        yield table(first, list(itertools.islice(every, at_once)), episodes, rng)


def write(root: Path, count: int, episodes: int) -> dict[str, Path]:
    """Write the same records in three ways, and return the folders."""
    folders = {name: root / name for name in ("one file", "packed", "a file for each unit")}
    for folder in folders.values():
        store.prepare(folder)
    single = folders["a file for each unit"] / store.FOLDER
    with pq.ParquetWriter(folders["one file"] / store.FOLDER / "all.parquet", SCHEMA, compression="zstd") as whole:
        # Row groups of the size that a table written at once has.
        for records in tables(count, episodes, ROW_GROUP // episodes):
            whole.write_table(records)
            for start in range(0, records.num_rows, episodes):
                own = records.slice(start, episodes)
                pq.write_table(own, single / f"{own['unit'][0]}.parquet", compression="zstd")
    shutil.copytree(single, folders["packed"] / store.FOLDER, dirs_exist_ok=True)
    start = time.process_time()
    packing.pack(folders["packed"])
    used = time.process_time() - start
    print(f"packing: {1e3 * used / count:.1f} ms of CPU time a unit")
    return folders


def write_packed(root: Path, count: int, episodes: int) -> dict[str, Path]:
    """Write packed files only."""
    out = root / "packed"
    store.prepare(out)
    for records in tables(count, episodes, packing.UNITS):
        units = [records.slice(start, episodes) for start in range(0, records.num_rows, episodes)]
        store.write_packed(out, units)
    return {"packed": out}


@dataclass(frozen=True)
class Named:
    """What `cavbench.records.finished` asks of a unit's pair."""

    id: str


@dataclass(frozen=True)
class Synthetic:
    """A unit, as far as its records must show it."""

    pair: Named
    cell: Cell
    training_seed: int
    seeds: range
    track: Track


def print_start(out: Path, count: int, episodes: int) -> None:
    """Print how long `bench run` looks for what is finished, if it wants all units of a folder, and if it wants none of them."""
    wanted = {}
    for number, one in enumerate(named(count)):
        row = _constants(number, *one)
        wanted[row["unit"]] = Synthetic(
            Named(str(row["pair"])), one[3], one[2], range(1_000_000, 1_000_000 + episodes), track("driving")
        )
    others = {f"{number:064x}": unit for number, unit in enumerate(wanted.values())}
    for what, units, expected in (("all", wanted, count), ("none", others, 0)):
        start, used = time.perf_counter(), time.process_time()
        found = finished(out, units)
        wall, cpu = time.perf_counter() - start, time.process_time() - used
        print(f"finished: {what} of {count} units in {cpu:.1f} s of CPU time, {wall:.1f} s", flush=True)
        assert len(found) == expected


def measure(out: Path, page: Path) -> tuple[float, float, float]:
    """Wall time and CPU time in seconds, and memory in GB, of a report."""
    command = [sys.executable, "-c", MEASURE, f"out={out}", f"html={page}"]
    code, wall, cpu, memory = map(float, subprocess.run(command, capture_output=True, text=True).stdout.split())
    if code:
        sys.exit("bench report failed")
    return wall, cpu, memory


def main() -> None:
    """Write the records, measure the reports and print the results."""
    parser = argparse.ArgumentParser(description="Measure `bench report html=PAGE` on many records.")
    parser.add_argument("--units", type=int, default=1_000)
    parser.add_argument("--episodes", type=int, default=100, help="of a unit")
    parser.add_argument("--rounds", type=int, default=1, help="reports; 0 for none")
    parser.add_argument("--packed", action="store_true", help="packed files only, and what a run needs to find them")
    arguments = parser.parse_args()
    count, episodes = arguments.units, arguments.episodes
    with tempfile.TemporaryDirectory() as root:
        made = write_packed if arguments.packed else write
        folders, page = made(Path(root), count, episodes), Path(root) / "leaderboard.html"
        if arguments.packed:
            print_start(folders["packed"], count, episodes)
        if not arguments.rounds:
            return
        rounds = [{name: measure(out, page) for name, out in folders.items()} for _ in range(arguments.rounds)]
        print(
            "| records | files | bytes a unit | wall, s | CPU, s | memory, GB | to one file |\n|---|---|---|---|---|---|---|"
        )
        for name, out in folders.items():
            paths = list((out / store.FOLDER).glob("*.parquet"))
            size = sum(path.stat().st_size for path in paths) // count
            wall, cpu, memory = (statistics.median(one[name][at] for one in rounds) for at in range(3))
            ratio = statistics.median(one[name][1] / one.get("one file", one[name])[1] for one in rounds)
            shown = f"{ratio:.2f} x" if "one file" in folders else ""
            print(f"| {name} | {len(paths)} | {size} | {wall:.1f} | {cpu:.1f} | {memory:.2f} | {shown} |")
        print(f"page of {page.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
