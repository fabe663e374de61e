"""The tables of lanes near a lane, and of where none is, leave out no lane that highway-env calls closest."""

from __future__ import annotations

import gymnasium
import highway_env  # noqa: F401
import numpy as np
import pytest

from cavbench.envs.roads.network import NEAR
from cavbench.envs.roads.originals import original

POINTS = 12
"""Random places close to each lane."""


@pytest.mark.parametrize(
    "task", ["merge-v0", "merge-generic-v0", "roundabout-v0", "exit-v0", "two-way-v0", "u-turn-v0", "racetrack-v0"]
)
def test_no_lane_is_left_out_where_it_is_closest(task: str) -> None:
    road, generator = original(task).scenes[0].road[0], np.random.default_rng(1)
    lanes = gymnasium.make(task, disable_env_checker=True).unwrapped.road.network.lanes_list()  # type: ignore[attr-defined]
    chosen = listed = alone = 0
    for number, lane in enumerate(lanes):
        near = {int(other) for other in road["near"][number] if other >= 0}
        listed += len(near)
        for _ in range(POINTS):
            along = generator.choice([0.0, lane.length, generator.uniform(0, lane.length)]) + generator.uniform(-1, 1)
            place = lane.position(along, generator.uniform(-NEAR, NEAR))
            distances = np.array([other.distance(place) for other in lanes])
            if distances[number] > NEAR:
                continue
            closer = set(np.flatnonzero(distances <= distances[number]).tolist()) - {number}
            assert closer <= near
            chosen += len(closer)
            first, last = (road["lanes"][name][number] for name in ("alone_from", "alone_to"))
            if first <= lane.local_coordinates(place)[0] <= last:
                assert not closer
                alone += 1
    # Ends of lanes are the beginnings of others, so some are closer; and a table of all lanes would prove nothing.
    assert chosen > 0
    assert alone > 0
    assert listed < len(lanes) * (len(lanes) - 1)
