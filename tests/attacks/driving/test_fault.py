"""Faults happen as often as their severity says, stay within their sets, and a report sums them up."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from rich.console import Console

from cavbench.attacks.driving.fault import DROPPED, MANNERS, Fault, Mode
from cavbench.core import suites
from cavbench.core.pair import Pair, choose
from cavbench.core.track import Job
from cavbench.driving import ObservationThreat
from cavbench.driving.attacker import Attacker
from cavbench.driving.drive import drive
from cavbench.driving.victim import CountedPolicy
from cavbench.envs.highway.axes import AXES
from cavbench.errors import UserError
from cavbench.leaderboard.terminal.faults import fault_rows, faults_report
from cavbench.records import reading
from tests.attacks.driving.victims import FEATURES, observations, victim

CELL = AXES.cell(lanes=3, density=2.0, weather="clear")
ALLOWED: dict[str, Any] = {
    "norm": "linf",
    "access": "dynamics",
    "presence": {"hidden": 9, "invented": 3},
    "latency": {"frames": 4},
    "held": {"share": 0.5, "longest": 15},
    "actuator": {"delay": 4, "replaced": 0.5},
}


def pair(name: str, policy: str = "dqn", max_steps: int = 30, allowed: Any = None, **params: Any) -> Pair:
    return Pair(
        attack=choose("attack", name, **params),
        defense=choose("defense", "none"),
        victim=choose("victim", policy),
        world=choose("world", "highway", max_steps=max_steps),
        threat=ObservationThreat(**(ALLOWED if allowed is None else allowed)),
    )


def driven(attacked: Pair, episodes: int = 6) -> Any:
    job = Job(pair=attacked, training_seed=0, attack_seed=0, cell=CELL, seeds=range(100, 100 + episodes))
    return drive(job, ()).columns


def test_a_row_is_missing_as_often_as_the_severity_says() -> None:
    threat = ObservationThreat(presence={"hidden": 9})  # type: ignore[arg-type]
    at_work = Attacker(Fault(mode="dropout", severity=3), CountedPolicy(victim("discrete")), threat, FEATURES, seed=0)
    truth = observations(400)
    hidden = sum(
        int(used.hidden.sum())
        for _ in range(10)
        if (used := at_work.show(truth, torch.ones(400, dtype=torch.bool), None).used)
    )
    share = hidden / (10 * int((truth[:, 1:, 0] > 0).sum()))
    assert abs(share - DROPPED[2]) < 0.01


@pytest.mark.parametrize("mode", [mode for mode in get_args(Mode) if mode not in MANNERS])
def test_every_fault_is_used_and_stays_within_its_set(mode: str) -> None:
    found = driven(pair("fault", mode=mode, severity=3))
    assert found["excess_max"].max() < 0.01
    column = {"dropout": "hidden", "ghosts": "invented", "latency": "age", "freeze": "age", "late": "acted"}.get(mode)
    column = "acted" if mode == "lost" else column or "linf"
    assert found[column].max() > 0
    others = {"hidden", "invented", "age", "acted"} - {column}
    assert all(not np.any(found[other]) for other in others)


def test_the_same_fault_falls_the_same_in_every_run() -> None:
    first, second = (driven(pair("fault", mode="ghosts", severity=3)) for _ in range(2))
    np.testing.assert_array_equal(first["safe_progress"], second["safe_progress"])
    np.testing.assert_array_equal(first["invented"], second["invented"])


def test_the_suite_allows_what_its_members_need() -> None:
    old, new = (suites.suite(name) for name in ("faults-1", "faults"))
    assert (len(old.members), len(new.members)) == (27, 33)
    assert new.members[:27] == old.members, "the records of version 1 are part of version 2"
    assert new.threat == old.threat
    for member in new.members:
        words = {word.partition("=")[0] for word in member.chosen.component.forges}
        assert any(word.split()[0] in {*new.threat, *member.threat} for word in words) or not words
        assert member.threat == {f"dynamics.{name}": value for name, value in member.chosen.component.manners.items()}


def test_other_drivers_of_a_fault_drive_otherwise_and_nothing_else_fails() -> None:
    parts = {"victim": choose("victim", "dqn"), "defense": choose("defense", "none")}
    made, skipped = suites.suite("faults").pairs(
        **parts, world=choose("world", "highway", max_steps=60), threat=ObservationThreat(**ALLOWED)
    )
    pairs = {(one.attack.component.mode, one.attack.component.severity): one for one in made}
    assert not skipped
    assert pairs["late", 1].threat == ObservationThreat(**ALLOWED)
    usual = driven(made[0].clean())
    for mode in MANNERS:
        found = driven(pairs[mode, 3])
        assert not np.any([found[name] for name in ("linf", "hidden", "invented", "age", "acted")])
        assert not np.array_equal(found["distance_m"], usual["distance_m"])


def test_other_drivers_than_the_severity_says_are_refused() -> None:
    with pytest.raises(UserError, match=r"allow it threat\.dynamics\.time_gap=0\.6 threat\.dynamics\.braking=7"):
        pair("fault", mode="rude", severity=2)
    wrong = pair("fault", allowed={"dynamics": {"time_gap": 2.0}}, mode="rude", severity=2)
    with pytest.raises(
        UserError, match=r"severity 2 of rude means threat\.dynamics\.time_gap=0\.6, the threat model has 2"
    ):
        driven(wrong)


def test_a_fault_that_the_threat_model_leaves_out_is_refused() -> None:
    with pytest.raises(UserError, match=r"allow it threat\.presence\.hidden=9"):
        pair("fault", allowed={"access": "oblivious"}, mode="dropout")


def test_a_set_that_the_victim_cannot_carry_out_is_refused() -> None:
    with pytest.raises(UserError, match="need continuous actions"):
        pair("fault", allowed={"actuator": {"noise": 0.1}}, mode="noise")


@pytest.mark.parametrize(
    ("name", "column"), [("hide", "hidden"), ("ghost", "invented"), ("late", "age"), ("steer", "acted")]
)
def test_an_adversary_uses_its_set_and_no_more(name: str, column: str) -> None:
    params = {"horizon": 0.4, "renew": 5}
    found = driven(pair(name, max_steps=20, **params), 3)
    assert found[column].max() > 0
    assert found["hidden"].max() <= 9
    assert found["invented"].max() <= 3
    assert found["age"].max() <= 4


def test_an_adversary_keeps_to_its_share_of_the_frames() -> None:
    allowed = {"access": "dynamics", "presence": {"hidden": 1, "share": 0.1}}
    found = driven(pair("hide", max_steps=20, allowed=allowed, horizon=0.4, renew=5, worth=0.0), 3)
    assert found["hidden"].max() <= 0.1 + 1e-9
    assert found["linf"].max() >= 0


def test_a_report_sums_up_what_faults_do(tmp_path: Path) -> None:
    from cavbench.api import score

    console = Console(quiet=True)
    with pytest.raises(UserError, match="no fault was driven"):
        faults_report({}, console)
    attacks = [Fault(mode="dropout", severity=3), Fault(mode="lost", severity=3)]
    world = choose("world", "highway", max_steps=10).component
    score("dqn", attacks, world=world, threat=ALLOWED, lanes=3, density=1.0, weather="clear", episodes=2, out=tmp_path)
    found = reading.read_all(tmp_path)
    faults_report(found, console)
    from cavbench.leaderboard.comparisons.reading import read_tracks

    (row,) = fault_rows(read_tracks(found))
    assert row.faults == 2
    assert row.worst <= row.mean
    assert row.idm > 0
    assert 0 <= row.crashed <= row.worst_crashed <= 1
