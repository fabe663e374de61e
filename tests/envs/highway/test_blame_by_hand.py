"""Blame in scenes that a reader can judge on paper."""

from __future__ import annotations

import numpy as np
import pytest

from cavbench.driving.blame import AVOIDABLE, AVOIDABLE_IDM, ROOM
from cavbench.driving.rss import safe_distance
from tests.envs.highway.scenes import Car, judged

FASTER, IDLE = 3, 1
HARD = -6.0
HZ = 15


def test_a_crash_from_behind_in_a_full_road_is_nobodys_to_avoid(monkeypatch: pytest.MonkeyPatch) -> None:
    # Boxed in on both sides and ahead. The car behind closes by 25 m/s with 15 m of room: no braking of 9 m/s2 helps.
    ego = Car(0, 1, 20)
    others = [Car(-20, 1, 45), Car(9, 1, 20), Car(0, 0, 20), Car(0, 2, 20)]
    found, decisions = judged(monkeypatch, [ego, *others], lanes=3, action=IDLE)
    assert decisions < 2 * HZ
    assert found[AVOIDABLE] == found[AVOIDABLE_IDM] == 0


def test_a_crash_into_a_braking_leader_is_avoidable(monkeypatch: pytest.MonkeyPatch) -> None:
    # 35 m of room at 25 m/s. The leader stops in 25^2 / 12 = 52 m; so does a driver who brakes with 5 m/s2, in 63 m.
    found, decisions = judged(
        monkeypatch, [Car(0, 0, 25), Car(40, 0, 25)], lanes=2, action=FASTER, command=lambda _: (HARD, 0.0)
    )
    assert decisions > HZ
    assert found[AVOIDABLE] == found[AVOIDABLE_IDM] == 1
    safe = float(safe_distance(np.array(25.0), np.array(25.0)))
    assert found[ROOM] == pytest.approx(35 / safe, rel=0.02)


def test_a_crash_into_a_leader_that_brakes_right_ahead_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    # 3 m of room at 10 m/s are gone in 0.3 s, in which brakes of 9 m/s2 take away less than 3 m/s. Cars are beside.
    wall = [Car(place, 1, 25) for place in (-10, 0, 10)]
    found, _ = judged(
        monkeypatch, [Car(0, 0, 25), Car(8, 0, 15), *wall], lanes=2, action=FASTER, command=lambda _: (-9.0, 0.0)
    )
    assert found[AVOIDABLE] == found[AVOIDABLE_IDM] == 0
    assert found[ROOM] < 0.2


def test_a_cut_in_with_room_is_avoidable_and_one_without_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    def cut_in(ahead: float, speed: float) -> dict[str, float]:
        with monkeypatch.context() as patch:
            cars = [Car(0, 1, 25), Car(ahead, 0, speed), Car(0, 2, 25)]
            return judged(patch, cars, lanes=3, action=FASTER, command=lambda _: (HARD, 4.0))[0]

    with_room, without = cut_in(45, 22), cut_in(8, 10)
    assert with_room[AVOIDABLE] == 1
    assert without[AVOIDABLE] == 0
    assert without[ROOM] < with_room[ROOM]
