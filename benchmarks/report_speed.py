"""Measures `bench report html=PAGE` on a million episode records of ten thousand units: time, memory and size of the page.

    python benchmarks/report_speed.py                      # in one file, packed as `bench run` does, a file for each unit
    python benchmarks/report_speed.py --episodes 100000 --rounds 1

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
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bench.plugins.contracts import Facts
from bench.plugins.track import track
from bench.records import packing, store
from bench.records.schema import schema
from bench.scenarios import Cell
from bench.statistics.episodes import as_text
from envs.highway.axes import STANDARD_V1

SEEDS, EPISODES, ATTACKS = 3, 100, 8
ROW_GROUP = 100_000
SCHEMA = schema(track("driving"))
FACTS = json.dumps(Facts(axes=STANDARD_V1.axes, decision_hz=15, max_steps=450).written())
POLICY = {f"parameter_{number}": 0.125 for number in range(15)}
MEASURE = """
import resource, subprocess, sys, time
start = time.perf_counter()
code = subprocess.run([sys.executable, "-m", "bench", "report", *sys.argv[1:]], stdout=subprocess.DEVNULL).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(code, time.perf_counter() - start, used.ru_utime + used.ru_stime, used.ru_maxrss / 1e6)
"""


def unit(number: int, defense: str, attack: str, seed: int, cell: Cell, rng: np.random.Generator) -> pa.Table:
    """The records of one unit of work."""
    clean = attack == "none"
    digest = hashlib.sha256(str(number).encode()).hexdigest()
    constants = {
        "unit": digest,
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
        "grid": "standard-v1",
        "cell": as_text(cell),
        "world_facts": FACTS,
        "attack_shipped_by": "cavbench 0.1.0",
        "weights_sha256": hashlib.sha256(f"{defense}{seed}".encode()).hexdigest(),
        "code_digest": hashlib.sha256(attack.encode()).hexdigest(),
        "libraries": json.dumps({"python": "3.11", "torch": "2.13.0", "torchrl": "0.14.1", "numpy": "2.4.6"}),
        "machine": f"Linux x86_64, machine {number % 4}, 2 cores",
        "created_at": datetime(2026, 1, 1, tzinfo=UTC),
        "wall_s": 12.5,
        "seed": 1_000_000 + np.arange(EPISODES),
        "crashed": rng.random(EPISODES) < 0.3,
        "offroad": np.zeros(EPISODES, bool),
        "steps": rng.integers(30, 450, EPISODES),
        "entropy": rng.integers(0, 2**62, EPISODES),
        "action_counts": rng.integers(0, 100, (EPISODES, 5)).tolist(),
    }
    columns = []
    for field in SCHEMA:
        value = constants.get(field.name, "" if pa.types.is_string(field.type) else rng.random(EPISODES))
        columns.append(pa.array(value if isinstance(value, list | np.ndarray) else [value] * EPISODES, field.type))
    return pa.table(columns, schema=SCHEMA)


def units(episodes: int) -> Iterator[pa.Table]:
    """The records of one unit after the other."""
    rng = np.random.default_rng(0)
    attacks = ["none", *(f"attack_{number}" for number in range(ATTACKS))]
    combinations = itertools.product(range(episodes // EPISODES), attacks, range(SEEDS), STANDARD_V1.cells())
    for number, (place, attack, seed, cell) in enumerate(itertools.islice(combinations, episodes // EPISODES)):
        yield unit(number, f"defense_{place}", attack, seed, cell, rng)


def write(root: Path, episodes: int) -> dict[str, Path]:
    """Write the same records in three ways, and return the folders."""
    folders = {name: root / name for name in ("one file", "packed", "a file for each unit")}
    for folder in folders.values():
        store.prepare(folder)
    single = folders["a file for each unit"] / store.FOLDER
    with pq.ParquetWriter(folders["one file"] / store.FOLDER / "all.parquet", SCHEMA, compression="zstd") as whole:
        waiting: list[pa.Table] = []
        for records in units(episodes):
            pq.write_table(records, single / f"{records['unit'][0]}.parquet", compression="zstd")
            waiting.append(records)
            # Row groups of the size that a table written at once has.
            if len(waiting) == ROW_GROUP // EPISODES:
                whole.write_table(pa.concat_tables(waiting))
                waiting = []
        if waiting:
            whole.write_table(pa.concat_tables(waiting))
    shutil.copytree(single, folders["packed"] / store.FOLDER, dirs_exist_ok=True)
    start = time.process_time()
    packing.pack(folders["packed"])
    used = time.process_time() - start
    print(f"packing: {1e3 * used * EPISODES / episodes:.1f} ms of CPU time a unit")
    return folders


def measure(out: Path, page: Path) -> tuple[float, float, float]:
    """Wall time and CPU time in seconds, and memory in GB, of a report."""
    command = [sys.executable, "-c", MEASURE, f"out={out}", f"html={page}"]
    code, wall, cpu, memory = map(float, subprocess.run(command, capture_output=True, text=True).stdout.split())
    if code:
        sys.exit("bench report failed")
    return wall, cpu, memory


def main() -> None:
    """Write the records, measure the reports and print the results."""
    parser = argparse.ArgumentParser(description="Measure `bench report html=PAGE` on a million records.")
    parser.add_argument("--episodes", type=int, default=1_000_000)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as root:
        folders, page = write(Path(root), arguments.episodes), Path(root) / "leaderboard.html"
        rounds = [{name: measure(out, page) for name, out in folders.items()} for _ in range(arguments.rounds)]
        print(
            "| records | files | bytes a unit | wall, s | CPU, s | memory, GB | to one file |\n|---|---|---|---|---|---|---|"
        )
        for name, out in folders.items():
            paths = list((out / store.FOLDER).glob("*.parquet"))
            size = sum(path.stat().st_size for path in paths) * EPISODES // arguments.episodes
            wall, cpu, memory = (statistics.median(one[name][at] for one in rounds) for at in range(3))
            ratio = statistics.median(one[name][1] / one["one file"][1] for one in rounds)
            print(f"| {name} | {len(paths)} | {size} | {wall:.1f} | {cpu:.1f} | {memory:.2f} | {ratio:.2f} x |")
        print(f"page of {page.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
