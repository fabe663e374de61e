"""Attacks of the Adversarial Robustness Toolbox: from the command line, in worker processes, to the records."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import pytest

from cavbench.core.track import track
from cavbench.records import reading
from tests.command import Said

pytest.importorskip("art")


def test_records_name_the_attack_and_the_version_of_art(bench: Callable[..., Said], tmp_path: Path) -> None:
    attacks = "art:SquareAttack,art:HopSkipJump,art:ProjectedGradientDescent,art:AutoProjectedGradientDescent"
    said = bench(
        "run",
        f"attack={attacks}",
        "attack.max_iter=4",
        *(
            "victim=toy",
            "world=toy",
            "world.max_steps=3",
            "threat.queries=20",
            "lanes=3,4",
            "density=1",
            "weather=clear",
        ),
        *("episodes=2", "seeds=0", "workers=2", "reference=false", f"out={tmp_path}"),
    )
    assert said.code == 0, said.err
    assert all(name in said.out for name in attacks.split(","))
    rows = [row for row in reading.read(tmp_path, track=track("driving")).to_pylist() if row["attack"] != "none"]
    assert {row["attack"] for row in rows} == set(attacks.split(","))
    assert {json.loads(row["attack_params"])["max_iter"] for row in rows} == {4}
    version = metadata.version("adversarial-robustness-toolbox")
    assert {json.loads(row["libraries"])["adversarial-robustness-toolbox"] for row in rows} == {version}
    assert max(row["queries_max"] for row in rows) <= 20
    assert next((tmp_path / "recordings").glob("art-SquareAttack-none-toy-*/*.rrd"))


def test_continuous_victims_are_refused_in_one_line(bench: Callable[..., Said]) -> None:
    said = bench("run", "attack=art:SquareAttack", "victim=ddpg")
    assert (said.code, len(said.err.splitlines())) == (2, 1)
    assert (
        "attack 'art:SquareAttack' does not fit victim 'ddpg', whose actions are continuous: it needs discrete ones"
        in said.err
    )
