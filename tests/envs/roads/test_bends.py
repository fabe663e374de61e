"""The way round of a network: its places are those of the lanes."""

from __future__ import annotations

import pytest
import torch

from cavbench.driving.intervals.bends import points
from cavbench.envs.roads import racetrack, u_turn
from cavbench.envs.roads.bends import way_round


def test_the_way_round_the_u_turn_is_that_of_its_lanes() -> None:
    network = u_turn.u_turn(connected=True)
    way = way_round(network, u_turn.WAY.roads, start=0.0, start_lane=0)
    for (first, last), station in zip(u_turn.WAY.roads, way.stations, strict=True):
        for number, lane in enumerate(network.graph[first][last]):
            for share in (0.0, 0.3, 0.99):
                length = network.graph[first][last][0].length
                found = points(way, torch.tensor(station + share * length), torch.tensor(4.0 * number))
                assert [float(one) for one in found] == pytest.approx(lane.position(share * lane.length, 0.0), abs=1e-3)


def test_roads_that_do_not_fit_together_are_refused_in_one_line() -> None:
    network = racetrack.racetrack(connected=True)
    with pytest.raises(ValueError, match="begins where") as refused:
        way_round(network, (("a", "b"), ("b", "c"), ("c", "d"), ("f", "g")), start=0.0, start_lane=0)
    assert "\n" not in str(refused.value)
