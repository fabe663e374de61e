"""`executor=ray` on a real cluster of two nodes on this machine: the same records, and a node that is killed loses nothing."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from cavbench.core.track import track
from cavbench.records import reading
from tests.command import import_path, ran, started
from tests.run.test_runner import comparable
from tests.tree import ROOT

pytest.importorskip("ray", reason="Ray is not installed: pip install 'cavbench[ray]'")

CELLS = ("attack=nudge", "victim=toy", "world=toy", "lanes=3,4,5", "density=1", "weather=clear,fog", "seeds=0,1")
RUN = ("run", *CELLS, "episodes=4", "record=0", "reference=false")


@pytest.fixture(scope="module")
def cluster(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A cluster of two nodes with a core each; the first has the driver, and both a folder of their own."""
    from ray.cluster_utils import Cluster

    before, here = dict(os.environ), Path.cwd()
    root = ROOT
    os.environ |= {"PYTHONPATH": import_path(toy_folder, root), "RAY_USAGE_STATS_ENABLED": "0", "OMP_NUM_THREADS": "1"}
    # Ray's workers are niced by 15, and beside another test would hardly run.
    os.environ |= {"RAY_worker_niceness": "0"}
    made = Cluster()
    try:
        for name in ("head", "other"):
            os.chdir(tmp_path_factory.mktemp(name))
            made.add_node(num_cpus=1, include_dashboard=False, object_store_memory=100_000_000)
        os.chdir(here)
        yield made
    finally:
        os.chdir(here)
        made.shutdown()
        os.environ.clear()
        os.environ.update(before)


@pytest.fixture(scope="module")
def serial(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> pa.Table:
    """The records of the same run in one process."""
    out = tmp_path_factory.mktemp("serial")
    said = ran(toy_folder, *RUN, "executor=serial", f"out={out}")
    assert said.code == 0, said.err
    return comparable(reading.read(out, track=track("driving")))


@pytest.mark.slow
def test_two_nodes_write_the_records_of_one_process_and_a_killed_node_loses_nothing(
    cluster: Any, serial: pa.Table, toy_folder: Path, tmp_path: Path
) -> None:
    words = (*RUN, "executor=ray", f"ray.address={cluster.address}")
    calm = ran(toy_folder, *words, f"out={tmp_path / 'calm'}")
    assert calm.code == 0, calm.err
    assert comparable(reading.read(tmp_path / "calm", track=track("driving"))).equals(serial)

    out = tmp_path / "killed"
    process = started(toy_folder, *words, f"out={out}")
    until = time.monotonic() + 240
    while len(list(out.glob("episodes/*.parquet"))) < 5:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.02)
    cluster.remove_node(cluster.list_all_nodes()[-1], allow_graceful=False)
    _, err = process.communicate(timeout=240)
    assert process.returncode == 0, err
    assert "failed" not in err
    assert comparable(reading.read(out, track=track("driving"))).equals(serial)


@pytest.mark.slow
def test_an_address_without_a_cluster_is_one_line(toy_folder: Path, tmp_path: Path) -> None:
    said = ran(toy_folder, *RUN, "executor=ray", "ray.address=127.0.0.1:1", f"out={tmp_path}")
    assert said.code == 2
    assert "there is no Ray cluster at ray.address=127.0.0.1:1" in said.err.splitlines()[-1]
