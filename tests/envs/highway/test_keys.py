"""highway-env's configuration keys: what the engine knows is read, anything else is named in one line."""

from __future__ import annotations

from typing import Any

import pytest

from cavbench.envs.highway.keys import decisions, fields_of, parsed

OWN = {"lanes_count": 3, "vehicles_density": 1.0}


def test_the_keys_are_highway_envs_and_set_the_fields_of_the_engine() -> None:
    read = fields_of(
        {
            "vehicles_count": 30,
            "duration": 60,
            "collision_reward": -2,
            "reward_speed_range": [15, 25],
            "initial_lane_id": 1,
            "action": {"type": "DiscreteMetaAction", "target_speeds": [10, 20, 30]},
            "observation": {
                "type": "Kinematics",
                "vehicles_count": 8,
                "features": ["presence", "x", "y", "vx", "vy"],
                "features_range": {"x": [-100, 100], "y": [-20, 20], "vx": [-40, 40], "vy": [-20, 20]},
                "absolute": False,
            },
        },
        OWN,
    )
    assert read == {
        "vehicles": 30,
        "duration": 60.0,
        "collision_reward": -2.0,
        "reward_speed_range": (15.0, 25.0),
        "start_lane": 1,
        "target_speeds": (10.0, 20.0, 30.0),
        "observed_vehicles": 8,
        "ranges": {"x": (-100.0, 100.0), "y": (-20.0, 20.0), "vx": (-40.0, 40.0), "vy": (-20.0, 20.0)},
    }


def test_what_only_draws_or_says_the_default_changes_nothing() -> None:
    highway_env = pytest.importorskip("highway_env.envs.highway_env")
    own = highway_env.HighwayEnvFast.default_config()
    assert fields_of(own, OWN).keys() <= {
        *("vehicles", "duration", "simulation_frequency", "policy_frequency", "ego_spacing", "collision_reward"),
        *("right_lane_reward", "high_speed_reward", "reward_speed_range", "normalize_reward", "offroad_terminal"),
        "start_lane",
    }


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ({"durations": 60}, "config has the key 'durations', which the engine does not know; known: vehicles_count, "),
        ({"lanes_count": 4}, "lanes_count is an axis of this world: leave it out of config, and write lanes=4"),
        ({"vehicles_density": 2}, "write density=2"),
        ({"vehicles_count": 1.5}, "config.vehicles_count must be a whole number, got 1.5"),
        ({"vehicles_count": True}, "config.vehicles_count must be a whole number, got True"),
        ({"duration": "long"}, "config.duration must be a number, got 'long'"),
        ({"normalize_reward": 1}, "config.normalize_reward must be true or false, got 1"),
        ({"reward_speed_range": 20}, "config.reward_speed_range must be a list of numbers, got 20"),
        ({"controlled_vehicles": 2}, "config.controlled_vehicles is 1 in the engine, got 2"),
        ({"other_vehicles_type": "mine"}, "config.other_vehicles_type is .*IDMVehicle"),
        ({"observation": "Kinematics"}, "config.observation takes keys and values, got 'Kinematics'"),
        ({"observation": {"type": "OccupancyGrid"}}, 'config.observation.type is "Kinematics" in the engine'),
        ({"observation": {"type": "Kinematics", "order": "shuffled"}}, 'observation.order is "sorted" in the engine'),
        ({"observation": {"type": "Kinematics", "features": ["x", "y"]}}, "config.observation.features is"),
        ({"observation": {"type": "Kinematics", "stack": 2}}, "config.observation has the key 'stack'"),
        ({"observation": {"type": "Kinematics", "features_range": {"x": [-1, 1]}}}, "must give all of x, y, vx, vy, y"),
        (
            {"observation": {"type": "Kinematics", "features_range": {"x": [1]}}},
            r"features_range.x must be \[low, high\]",
        ),
        (
            {"action": {"type": "DiscreteAction"}},
            "config.action.type must be one of DiscreteMetaAction, ContinuousAction",
        ),
        ({"action": {"type": "ContinuousAction", "dynamical": True}}, "config.action.dynamical is false in the engine"),
    ],
)
def test_anything_else_is_named_in_one_line(bad: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said) as caught:
        fields_of(bad, OWN)
    assert "\n" not in str(caught.value)


def test_a_configuration_is_a_mapping_or_its_json() -> None:
    assert parsed({"duration": 60}) == parsed('{"duration": 60}') == {"duration": 60}
    assert parsed("") == {}
    for bad in ("duration", "[60]", "{" * 100_000):
        with pytest.raises(ValueError, match="config takes highway-env's keys"):
            parsed(bad)


def test_an_episode_has_as_many_decisions_as_in_highway_env() -> None:
    """It adds up 1 / frequency in floating-point numbers."""
    found = {rate: decisions(30, rate) for rate in (1, 3, 5, 10, 15)}
    assert found == {1: 30, 3: 91, 5: 151, 10: 300, 15: 451}
    for bad in (0, -1, 1e9, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=r"config.duration must be above 0"):
            decisions(bad, 15)
