"""A substitute is trained from decisions alone, and its lies are shown to the victim."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from cavbench.attacks.driving.substitute import Copy, _agreement, _fit, _moved
from cavbench.core.track import track
from cavbench.records import reading
from tests.attacks.driving.victims import observations, victim
from tests.cli.test_cli import assert_one_line
from tests.command import Bench

SHORT = ("attack=substitute", "attack.frames=50", "attack.rounds=1", "attack.epochs=2", "attack.hidden=8")
RUN = ("lanes=3", "density=1", "weather=clear", "episodes=2", "record=0", "reference=false", "executor=serial")


@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
def test_moved_frames_have_the_same_cars_and_are_no_farther_than_the_reach(action_type: str) -> None:
    policy, seen = victim(action_type, 0), observations(30)  # type: ignore[arg-type]
    moved = _moved(policy, seen, policy.decide(seen), 0.05)
    assert torch.equal(moved[..., 0], seen[..., 0])
    assert torch.equal(moved[seen[..., 0] == 0], seen[seen[..., 0] == 0])
    assert float((moved - seen).abs().max()) <= 0.05 + 1e-6
    assert float(moved.abs().max()) <= 1
    assert not torch.equal(moved, seen)


def test_a_substitute_learns_to_decide_as_the_victim_does() -> None:
    torch.manual_seed(0)
    policy, seen, new = victim("discrete", 4), observations(1500, 1), observations(500, 2)
    network = Copy(5, 5, 32, 1.0)
    asked, compared = policy.decide(seen), policy.decide(new)
    _fit(network.policy, seen, asked, 10)
    most = float(torch.bincount(compared).max()) / len(compared)
    assert _agreement(network.policy, new, compared) > most + 0.1


@pytest.mark.slow
def test_it_is_trained_for_a_victim_then_run_without_a_query(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path / "zoo"))
    run = ("run", *SHORT, "victim=ddpg", *RUN, "world.max_steps=20", "seeds=0", f"out={tmp_path / 'results'}")
    assert_one_line(bench(*run), "the zoo has no 'substitute-ddpg' with")
    assert bench("train", *SHORT, "victim=ddpg", "seeds=0").code == 0
    assert bench(*run).code == 0
    records = reading.read(tmp_path / "results", track=track("driving"))
    attacked = [row for row in records.to_pylist() if row["attack"] == "substitute"]
    assert len(attacked) == 2
    assert {row["queries"] for row in attacked} == {0.0}
    assert all(row["linf"] > 0 for row in attacked)


def test_whoever_may_not_ask_for_decisions_cannot_have_trained_it(bench: Bench) -> None:
    said = bench("run", "attack=substitute", "victim=dqn", "threat.access=oblivious", "episodes=1", "seeds=0")
    assert_one_line(said, "attack 'substitute' needs access 'decisions'", "threat.access=decisions")
