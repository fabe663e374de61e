"""The monitor is silent about true measurements, sees lies that no car could drive, and lets another driver take over."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from cavbench.core.pair import Pair, choose
from cavbench.core.track import Job, track
from cavbench.driving.threat import ObservationThreat
from cavbench.errors import UserError
from cavbench.scenarios import SeedBlock

STEPS = 75


@cache
def driven(attack: str, victim: str = "dqn", weather: str = "clear", **defense: Any) -> dict[str, Any]:
    pair = Pair(
        attack=choose("attack", attack),
        defense=choose("defense", "monitor", **defense),
        victim=choose("victim", victim),
        world=choose("world", "highway", max_steps=STEPS),
        threat=ObservationThreat(),
    )
    seeds = range(SeedBlock.TUNE, SeedBlock.TUNE + 4)
    cell = pair.world.component.axes.cell(lanes=4, density=1.0, weather=weather)
    return dict(
        track("driving").drive(Job(pair=pair, training_seed=0, attack_seed=1, cell=cell, seeds=seeds), None, []).columns
    )


@pytest.mark.parametrize("weather", ["clear", "rain", "fog"])
def test_true_measurements_raise_no_alarm(weather: str) -> None:
    columns = driven("none", weather=weather)
    assert (columns["suspicion"] < 1).all()
    assert not columns["alarms"].any()
    assert np.isnan(columns["alarm_delay_s"]).all()


@pytest.mark.parametrize(("attack", "seconds"), [("noise", 0.5), ("pessimist", 4.0)])
def test_lies_that_no_car_could_drive_are_seen(attack: str, seconds: float) -> None:
    columns = driven(attack)
    assert (columns["suspicion"] > driven("none")["suspicion"]).all()
    assert (columns["alarms"] >= 1).all()
    assert (columns["alarm_delay_s"] <= seconds).all()


def test_a_scaled_motion_stays_unseen() -> None:
    columns = driven("scaling")
    assert (columns["suspicion"] < 1).all()
    assert (columns["alarm_delay_s"] == math.inf).all()


def test_the_fallback_drives_after_an_alarm_and_only_then() -> None:
    without = {name: driven(name, fallback="none") for name in ("none", "noise")}
    assert np.array_equal(driven("none")["return"], without["none"]["return"])
    assert (
        driven("noise", fallback="brake")["action_counts"][:, 4].min()
        > 0.8 * driven("noise", fallback="brake")["steps"].min()
    )
    assert (driven("noise")["action_counts"] != without["noise"]["action_counts"]).any(1).all()


def test_a_victim_without_a_monitor_says_nothing_of_alarms() -> None:
    assert (
        choose("victim", "dqn")
        .component.load(0, choose("world", "highway").component.facts)
        .suspicion(torch.zeros(1, 10, 5), None)
        is None
    )


@pytest.mark.parametrize(
    ("victim", "defense", "line"),
    [("ddpg", {}, "fallback=none"), ("idm", {}, "needs a victim that sees")],
)
def test_what_it_cannot_watch_is_refused(victim: str, defense: dict[str, Any], line: str) -> None:
    with pytest.raises(UserError, match=line):
        driven("none", victim=victim, **defense)


def test_a_continuous_victim_is_watched_without_a_fallback() -> None:
    assert driven("noise", victim="ddpg", fallback="none")["alarms"].min() >= 1
