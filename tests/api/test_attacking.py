"""`cavbench.attack`: one observation, one call."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import cavbench
from cavbench.driving import ObservationThreat
from cavbench.driving.access import DRAWS
from cavbench.isolation.modes import numbers, stacked
from tests.isolation.torch_modes import CALLERS

CELL: dict[str, Any] = {"lanes": 3, "density": 1, "weather": "clear"}
PGD = cavbench.component("attack", "pgd", steps=2, restarts=1)
MARGIN = {"objective": "margin", "steps": 4, "restarts": 1}


@pytest.fixture(scope="module")
def observed() -> Any:
    env = cavbench.gym.make("highway", **CELL)
    return np.stack([env.reset(seed=seed)[0] for seed in (1, 2, 3)])


@pytest.mark.parametrize("attack", ["noise", "bias", "zo", "pgd", "two_stage"])
def test_an_observation_is_attacked_within_the_threat_model_and_paid_for(attack: str, observed: Any) -> None:
    found = cavbench.attack(attack, "dqn", observed)
    world = cavbench.component("world", "highway")
    truth = torch.from_numpy(observed)
    radius = ObservationThreat().radius(truth, world.features).numpy()
    assert found.observation.dtype == observed.dtype
    assert (np.abs(found.observation - observed) <= radius + 1e-6).all()
    assert (found.size > 0).all()
    assert found.queries.shape == (3,)
    asks = attack not in ("noise", "bias")
    assert (found.queries > 0).all() == asks
    assert (found.gradients > 0).all() == (attack in ("pgd", "two_stage"))
    assert (found.queries <= 1000).all()


def test_one_observation_has_numbers_of_its_own(observed: Any) -> None:
    one = cavbench.attack("pgd", "dqn", torch.from_numpy(observed[0]), seed=4)
    again = cavbench.attack("pgd", "dqn", observed[0], seed=4)
    assert isinstance(one.observation, torch.Tensor)
    assert one.observation.shape == (10, 5)
    assert (one.observation.numpy() == again.observation).all()
    assert one.queries.ndim == 0
    assert isinstance(one.changed, bool)
    assert one.changed == (one.clean != one.taken)
    other = cavbench.attack("noise", "dqn", observed[0], seed=5).observation
    assert (other != cavbench.attack("noise", "dqn", observed[0], seed=4).observation).any()


def test_the_array_of_an_environment_is_attacked_in_its_own_units() -> None:
    pytest.importorskip("highway_env")
    env = gymnasium.make("merge-v0")
    observation, _ = env.reset(seed=1)
    network = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(25, 5))
    found = cavbench.attack(cavbench.component("attack", "pgd", **MARGIN), network, observation, world="merge-v0")
    assert found.observation.shape == (5, 5)
    assert (found.observation[:, 0] == observation[:, 0]).all(), "presence"
    moved = np.abs(found.observation - observation)
    assert moved.max() > 0
    assert (moved <= np.maximum(0.1 * np.abs(observation), 0.025) + 1e-6).all()
    absent = observation[:, 0] == 0
    assert (found.observation[absent] == observation[absent]).all()


def test_the_budget_of_queries_holds(observed: Any) -> None:
    found = cavbench.attack("zo", "dqn", observed, threat={"queries": 7, "budget": 0.02})
    assert found.queries.max() <= 7
    assert found.size.max() <= 0.021


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"observation": np.zeros((10, 4))}, r"has the shape \[10, 5\], or \[B, …\] for several, got \[10, 4\]"),
        ({"observation": np.full((10, 5), np.nan)}, "contains NaN or infinity"),
        ({"observation": np.full((10, 5), 1.5)}, r"has numbers outside of \[-1, 1\]"),
        ({"observation": "x"}, "an array or a tensor of numbers, got str"),
        ({"attack": "pdg"}, "did you mean 'pgd'"),
        ({"threat": {"access": "scores"}}, "needs access 'gradients'"),
        ({"policy": "blind"}, "does not fit victim 'blind', which ignores its input"),
        ({"world": "camera"}, "is for driving policies"),
        ({"lane": 3}, "unknown argument or axis 'lane'; did you mean 'lanes'"),
    ],
)
def test_what_is_wrong_is_one_line(changes: dict[str, Any], line: str) -> None:
    given: dict[str, Any] = {"attack": "pgd", "policy": "dqn", "observation": np.zeros((10, 5), np.float32)} | changes
    with pytest.raises(cavbench.UserError, match=line):
        cavbench.attack(given.pop("attack"), given.pop("policy"), given.pop("observation"), **given)


def test_an_attack_that_knows_the_dynamics_needs_no_more_words(observed: Any) -> None:
    assert cavbench.attack("plan", "dqn", observed, **CELL).queries.min() > 0


@pytest.mark.parametrize("mode", CALLERS)
def test_what_the_caller_has_switched_on_changes_no_answer(mode: str, observed: Any) -> None:
    """In inference mode an attack had no gradient."""
    wanted = cavbench.attack(PGD, "dqn", observed, seed=4)
    with CALLERS[mode]():
        before = stacked(), numbers(), torch.is_grad_enabled()
        found = cavbench.attack(PGD, "dqn", observed, seed=4)
        assert (stacked(), numbers(), torch.is_grad_enabled()) == before
    assert (wanted.observation != observed).any()
    assert (found.observation == wanted.observation).all()
    assert (found.clean == wanted.clean).all()


def test_a_random_victim_is_asked_several_times_about_each_point_as_in_a_run(observed: Any) -> None:
    once, often = (cavbench.attack(PGD, "dqn", observed, defense=defense) for defense in ("none", "smoothing"))
    assert (often.queries == DRAWS * once.queries).all()
