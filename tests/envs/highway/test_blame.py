"""Blame: a crash that a careful driver avoids is avoidable, one that nobody survives is not."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from cavbench.core.pair import choose
from cavbench.driving import Control
from cavbench.driving.blame import AVOIDABLE, AVOIDABLE_IDM, ROOM, Deeds
from cavbench.driving.rollout import rollout
from cavbench.driving.sets import Traffic
from cavbench.driving.surroundings import Surroundings
from cavbench.driving.threat import ObservationThreat
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.blame import blame
from cavbench.envs.highway.config import HighwayConfig
from cavbench.envs.highway.engine import HighwayEngine

BATCH = 12
BOUNDS = Traffic(cars=1, braking=9.0, gap=0.0, headway=0.0, closing=80.0, lateral_speed=4.0)
CONFIG = HighwayConfig(cells=(AXES.cell(lanes=3, density=1.0),) * BATCH, traffic=BOUNDS)
FASTER, SLOWER = 3, 4


def driven(action: int, after: int, config: HighwayConfig = CONFIG) -> tuple[Deeds, np.ndarray, np.ndarray]:
    """Episodes in which the ego only does `action`, and the nearest car ahead cuts in and brakes from decision `after` on."""
    engine = HighwayEngine(config)
    seeds = np.arange(BATCH) + 500
    engine.reset(np.arange(BATCH), seeds)
    deeds, actions = Deeds(seeds), np.full(BATCH, action)
    for step in range(200):
        orders = np.zeros((*engine.vehicles.shape, 3))
        if step >= after:
            ego = engine.vehicles[:, :1]
            ahead = engine.vehicles["x"] - ego["x"]
            car = np.where((ahead > 5) & ~engine.vehicles["crashed"], ahead, np.inf).argmin(1)
            orders[np.arange(BATCH), car] = np.stack((np.ones(BATCH), np.full(BATCH, -9.0), ego["y"][:, 0]), 1)
        deeds.actions.append(actions.copy())
        deeds.orders.append(orders)
        engine.order_cars(orders)
        engine.step(actions)
        if engine.episodes["terminated"].all():
            break
    return deeds, engine.episodes["steps"].copy(), engine.episodes["crashed"].copy()


def test_tailgating_into_a_braking_car_is_avoidable() -> None:
    deeds, decisions, crashed = driven(FASTER, after=30)
    assert crashed.sum() >= 6
    found = blame(CONFIG, deeds, decisions, crashed)
    assert np.isnan(found[AVOIDABLE][~crashed]).all()
    assert found[AVOIDABLE][crashed].mean() > 0.7
    assert set(found[AVOIDABLE_IDM][crashed]) <= {0.0, 1.0}
    assert np.nanmin(found[ROOM]) >= 0


def test_what_a_victim_decides_that_the_world_drives_is_not_repeated() -> None:
    # IDM is at the wheel, so the decisions change nothing.
    config = replace(CONFIG, driver="idm")
    deeds, decisions, crashed = driven(FASTER, 30, config)
    other, *same = driven(SLOWER, 30, config)
    assert crashed.any()
    np.testing.assert_array_equal(same, (decisions, crashed))
    first, second = (blame(config, one, decisions, crashed) for one in (deeds, other))
    for name, values in first.items():
        np.testing.assert_array_equal(values, second[name])


def test_a_crash_right_at_the_start_is_judged_from_the_first_decision() -> None:
    deeds, decisions, crashed = driven(FASTER, after=0)
    assert crashed.any()
    found = blame(CONFIG, deeds, decisions, crashed)
    assert np.isfinite(found[AVOIDABLE][crashed]).all()


def test_what_the_victim_did_is_repeated_to_the_last_bit_and_nothing_is_said_without_a_crash() -> None:
    deeds, decisions, crashed = driven(FASTER, after=30)
    first, second = (blame(CONFIG, deeds, decisions, crashed) for _ in range(2))
    for name, values in first.items():
        np.testing.assert_array_equal(values, second[name])
    nothing = blame(CONFIG, deeds, decisions, np.zeros(BATCH, bool))
    assert all(np.isnan(values).all() for values in nothing.values())


def test_a_crash_that_nobody_can_avoid_is_not_avoidable(monkeypatch: pytest.MonkeyPatch) -> None:
    # The wheel is taken only at the last moment.
    monkeypatch.setattr("cavbench.envs.highway.blame.TAKEOVER_S", 0.2)
    deeds, decisions, crashed = driven(FASTER, after=30)
    found = blame(CONFIG, deeds, decisions, crashed)
    assert found[AVOIDABLE][crashed].mean() < 0.5


@pytest.mark.parametrize("reaction", [0.0, 1.5])
def test_crashes_are_judged_where_the_traffic_drives_otherwise_and_only_there(reaction: float) -> None:
    world, victim, attack = (
        choose(kind, name, **params).component
        for kind, name, params in (
            ("world", "highway", {}),
            ("victim", "blind", {"policy": "faster"}),
            ("attack", "noise", {}),
        )
    )
    around = Surroundings(reaction=reaction)
    cells, facts = CONFIG.cells[:4], world.facts_at(CONFIG.cells[0])
    control = Control(action_type="discrete", driver="agent", surroundings=around)
    found = rollout(
        world.build(cells, control),
        victim.load(0, facts),
        attack,
        ObservationThreat(budget=0.0, dynamics=around),
        [500, 501, 502, 503],
        facts=facts,
        attack_seed=0,
        judge=partial(world.blame, cells, control),
    )
    crashed = found["crashed"].astype(bool)
    assert crashed.all()
    assert np.isfinite(found[AVOIDABLE]).all() == np.isfinite(found[AVOIDABLE_IDM]).all() == (reaction > 0)
    assert np.isnan(found[ROOM]).all(), "no car was driven"
