"""End-to-end tests with real components: the highway world, an input-independent policy and the DQN of the zoo."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest

from cavbench import zoo
from cavbench.core.track import track
from cavbench.driving.victims.dqn import DQN
from cavbench.envs.highway.world import HighwayWorld
from cavbench.records import reading
from cavbench.run.replay import find, replay
from tests.command import Said

ROAD = ("lanes=3", "density=1", "weather=clear,fog", "episodes=3")


@pytest.mark.slow
def test_an_input_independent_policy_is_scored_and_an_episode_replayed(
    bench: Callable[..., Said], tmp_path: Path
) -> None:
    said = bench("run", "victim=blind", *ROAD, "workers=2", f"out={tmp_path}")
    assert said.code == 0, said.err
    assert "IDM" in said.out
    records = reading.read(tmp_path, track=track("driving"))
    assert set(records["cell"].to_pylist()) == {'{"lanes":3,"density":1.0,"weather":"clear"}'}
    braking = records.filter(pc.field("victim_params") == '{"policy":"slower"}')
    assert braking.num_rows == 3
    assert not any(braking["crashed"].to_pylist())
    np.testing.assert_array_equal(braking["steps"], 450)
    assert 0 < max(braking["safe_progress"].to_pylist()) < 0.5
    assert replay(tmp_path, find(records, {"victim": "random", "seed": "1000001"})).differences == ()


@pytest.mark.slow
def test_the_dqn_drives_on_the_highway_under_noise(bench: Callable[..., Said], tmp_path: Path) -> None:
    seed = zoo.seeds(zoo.Recipe.of(DQN()))[0]
    said = bench("run", "attack=noise", *ROAD, f"seeds={seed}", "workers=2", "reference=false", f"out={tmp_path}")
    assert said.code == 0, said.err
    records = reading.read(tmp_path, track=track("driving"))
    assert records.num_rows == 2 * 2 * 3
    assert set(records["weights_sha256"].to_pylist()) == {DQN().load(seed, HighwayWorld().facts).weights_sha256}
    attacked, clean = (records.filter(pc.field("attack") == name) for name in ("noise", "none"))
    assert min(attacked["linf"].to_pylist()) > 0
    assert set(clean["linf"].to_pylist()) == {0.0}
    assert max(attacked["excess_max"].to_pylist()) < 1e-6
    assert replay(tmp_path, find(attacked, {"weather": "fog"})).differences == ()
