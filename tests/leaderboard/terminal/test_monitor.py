from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavbench.errors import UserError
from cavbench.leaderboard.terminal.monitor import KEY, area, monitor_report, watched
from cavbench.terminal import Console


def row(seed: int, suspicion: float, score: float, delay: float | None = None, alarms: float = 0.0):
    identity = {"world": "highway", "world_params": "{}", "cell": "{}", "seed": seed, "training_seed": 0}
    facts = json.dumps({"decision_hz": 10})
    return identity | {
        "suspicion": suspicion,
        "safe_progress": score,
        "alarm_delay_s": delay,
        "alarms": alarms,
        "steps": 1800,
        "world_facts": facts,
    }


def test_the_columns_are_those_of_the_page() -> None:
    clean = [row(0, 0.2, 0.9), row(1, 0.6, 0.8, alarms=1)]
    attacked = [row(0, 3.0, 0.5, 1.5, 1), row(1, 0.4, 0.3, np.inf)]
    found = watched(attacked, {tuple(one[name] for name in KEY): one for one in clean})
    # 1 alarm in 2 x 180 s.
    assert found.false_alarms == pytest.approx(10)
    assert (found.seen, found.delay_s, found.area) == (0.5, 1.5, 0.75)
    assert found.score == pytest.approx(0.4)
    # The episode that is seen counts as without an attack.
    assert found.unseen == pytest.approx((0.9 + 0.3) / 2)
    assert found.clean == pytest.approx(0.85)


@given(st.lists(st.integers(0, 5), min_size=1, max_size=8), st.lists(st.integers(0, 5), min_size=1, max_size=8))
def test_the_area_is_the_chance_of_the_right_order(attacked: list[int], clean: list[int]) -> None:
    expected = np.mean([(one > other) + (one == other) / 2 for one in attacked for other in clean])
    assert area(np.array(attacked, float), np.array(clean, float)) == pytest.approx(expected)


def test_records_without_a_monitor_are_refused_in_a_line() -> None:
    with pytest.raises(UserError, match="defense=monitor"):
        monitor_report({}, Console())


def test_records_without_a_control_are_refused_in_a_line() -> None:
    with pytest.raises(UserError, match="no clean control"):
        watched([row(0, 1.0, 0.5, 0.1)], {})
