"""Misbehaviour detection: silent without an attack, quick under one, and safe after it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cavbench.attacks.driving.false_data import FalseData
from cavbench.attacks.driving.impostor import Impostor
from cavbench.defenses.driving.misbehaviour import Misbehaviour
from cavbench.driving import DrivingAttack, ObservationThreat
from cavbench.driving.rollout import rollout
from cavbench.driving.victims.cacc import CACC
from cavbench.driving.victims.path import PATH
from cavbench.envs.platoon.axes import CYCLES
from cavbench.envs.platoon.world import PlatoonWorld
from cavbench.errors import UserError

WORLD = PlatoonWorld(max_steps=200)
LARGE = {"senders": 1, "position": 20.0, "speed": 5.0, "acceleration": 2.0, "delay": 10, "dropped": 0.9}


def driven(
    attack: DrivingAttack | None,
    victim: CACC | PATH,
    defense: Misbehaviour | None,
    allowed: dict[str, Any] = LARGE,
    loss: float = 0.0,
    cycles: tuple[str, ...] = CYCLES,
) -> dict[str, Any]:
    cells = [WORLD.axes.cell(place=2, cycle=cycle, loss=loss) for cycle in cycles]
    env = WORLD.make(cells, action_type="continuous")
    facts = WORLD.facts
    policy = victim.load(0, facts) if defense is None else defense.load(victim, 0, facts)
    threat = ObservationThreat(messages=allowed, access="dynamics")  # type: ignore[arg-type]
    dynamics = WORLD.dynamics(cells, "continuous")
    return rollout(env, policy, attack, threat, range(len(cells)), facts=facts, attack_seed=0, dynamics=dynamics)


def test_it_keeps_the_rules_with_a_victim_that_listens() -> None:
    from cavbench.checks import examine

    found = {
        one.check: one.text for one in examine("defense", "misbehaviour", {}, victim="cacc") if one.status != "pass"
    }
    assert found == {}


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_there_is_no_alarm_without_an_attack_and_the_victim_drives_as_alone(loss: float) -> None:
    guarded = driven(None, CACC(), Misbehaviour(), loss=loss)
    assert (guarded["suspicion"] < 1).all()
    assert (guarded["alarms"] == 0).all()
    assert np.array_equal(guarded["safe_progress"], driven(None, CACC(), None, loss=loss)["safe_progress"])


def test_a_large_lie_is_found_at_once_and_path_no_longer_crashes() -> None:
    alone, guarded = (driven(FalseData(), PATH(), one) for one in (None, Misbehaviour()))
    assert alone["crashed"].all()
    assert not guarded["crashed"].any()
    assert (guarded["alarm_delay_s"] == 0).all()


def test_a_ramp_is_found_while_it_is_small() -> None:
    guarded = driven(FalseData(mode="ramp"), CACC(), Misbehaviour())
    # 3 m of 20 m, or 0.8 m/s of 5 m/s, within 10 s.
    assert (guarded["alarm_delay_s"] < 2.5).all()
    assert not guarded["crashed"].any()


def test_a_lie_within_the_limits_is_not_found() -> None:
    small = {"senders": 1, "position": 0.5, "speed": 0.1, "acceleration": 0.2}
    assert np.isinf(driven(FalseData(), CACC(), Misbehaviour(), small, cycles=("motorway",))["alarm_delay_s"]).all()


def test_without_a_fallback_the_alarm_is_only_recorded() -> None:
    alone, watched = (driven(FalseData(), CACC(), one) for one in (None, Misbehaviour(fallback="none")))
    assert np.array_equal(alone["safe_progress"], watched["safe_progress"])
    assert (watched["alarms"] > 0).all()


def test_a_search_finds_at_least_the_constant_lie() -> None:
    """In a world with short episodes both bring `path` to a crash; `away` costs progress."""
    assert driven(Impostor(horizon=2.0, renew=10), PATH(), None, cycles=("motorway",))["crashed"].all()
    away = driven(Impostor(aim="away", horizon=2.0, renew=10), CACC(), None, cycles=("motorway",))
    assert away["safe_progress"] < driven(None, CACC(), None, cycles=("motorway",))["safe_progress"] - 0.1


def test_it_is_refused_where_nobody_sends() -> None:
    from cavbench.envs.highway.world import HighwayWorld

    with pytest.raises(UserError, match="world=platoon"):
        Misbehaviour().load(CACC(), 0, HighwayWorld().facts)
