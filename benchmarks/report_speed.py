"""Measures `bench report html=PAGE` on a million episode records: wall time, memory and size of the page.

    python benchmarks/report_speed.py                    # a thousand files of a thousand records
    python benchmarks/report_speed.py --units 1          # as `bench run` writes them: ten thousand files, one per unit

The records are synthetic: measurements are random, and provenance texts are as long as in real records.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bench.plugins.contracts import Facts
from bench.plugins.track import track
from bench.records.schema import schema
from bench.records.store import FOLDER
from bench.scenarios import Cell
from bench.statistics.episodes import as_text
from envs.highway.axes import STANDARD_V1

SEEDS, EPISODES, ATTACKS = 3, 100, 8
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
        "action_counts": rng.integers(0, 100, (EPISODES, 5)).tolist(),
    }
    columns = []
    for field in SCHEMA:
        value = constants.get(field.name, "" if pa.types.is_string(field.type) else rng.random(EPISODES))
        columns.append(pa.array(value if isinstance(value, list | np.ndarray) else [value] * EPISODES, field.type))
    return pa.table(columns, schema=SCHEMA)


def write(out: Path, episodes: int, units: int) -> int:
    """Write records, `units` of work per file, and return the number of files."""
    folder = out / FOLDER
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    attacks = ["none", *(f"attack_{number}" for number in range(ATTACKS))]
    combinations = itertools.product(range(episodes // EPISODES), attacks, range(SEEDS), STANDARD_V1.cells())
    waiting, files = [], 0
    for number, (place, attack, seed, cell) in enumerate(itertools.islice(combinations, episodes // EPISODES)):
        waiting.append(unit(number, f"defense_{place}", attack, seed, cell, rng))
        if len(waiting) == units:
            pq.write_table(pa.concat_tables(waiting), folder / f"{number:06d}.parquet", compression="zstd")
            waiting, files = [], files + 1
    return files


def main() -> None:
    """Write the records, measure the report and print the results."""
    parser = argparse.ArgumentParser(description="Measure `bench report html=PAGE` on a million records.")
    parser.add_argument("--episodes", type=int, default=1_000_000)
    parser.add_argument("--units", type=int, default=10, help="units of work (100 episodes each) per file")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out, page = Path(folder) / "results", Path(folder) / "leaderboard.html"
        start = time.perf_counter()
        files = write(out, arguments.episodes, arguments.units)
        print(f"{arguments.episodes} records in {files} files, written in {time.perf_counter() - start:.0f} s")
        command = [sys.executable, "-c", MEASURE, f"out={out}", f"html={page}"]
        code, wall, cpu, memory = map(float, subprocess.run(command, capture_output=True, text=True).stdout.split())
        if code:
            sys.exit("bench report failed")
        print(f"page in {wall:.1f} s ({cpu:.1f} s of CPU time), {memory:.2f} GB, {page.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
