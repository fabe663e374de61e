"""RSS's safe distance is the least at which the rear car stops in time."""

from __future__ import annotations

import numpy as np
import pytest

from cavbench.driving.rss import ACCELERATION, BRAKING, HARDEST, RESPONSE_S, safe_distance


@pytest.mark.parametrize(("rear", "front"), [(30.0, 20.0), (25.0, 25.0), (20.0, 0.0), (10.0, 12.0)])
def test_at_the_distance_the_cars_stop_bumper_to_bumper(rear: float, front: float) -> None:
    dt, gap, speeds, time = 1e-3, float(safe_distance(np.array(rear), np.array(front))), [rear, front], 0.0
    while speeds[0] > 0:
        pull = ACCELERATION if time < RESPONSE_S else -BRAKING
        gap += dt * (speeds[1] - speeds[0])
        speeds = [max(speeds[0] + dt * pull, 0.0), max(speeds[1] - dt * HARDEST, 0.0)]
        time += dt
    assert gap == pytest.approx(0.0, abs=0.1)


def test_a_car_that_is_much_slower_needs_no_distance() -> None:
    assert safe_distance(np.array([2.0]), np.array([30.0])).tolist() == [0.0]
