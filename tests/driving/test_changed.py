"""Which decisions an attack changed: the noise of a random victim is no success of the attack."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.pair import Chosen, Pair, choose
from cavbench.defenses.driving.smoothing import Smoothed
from cavbench.driving import ObservationThreat, Oracle, Policy
from cavbench.driving.one_step import Session
from cavbench.driving.rollout import Trace, rollout
from tests.driving import cheats
from tests.driving.cheats import Does, Noisy, Victim, drive
from tests.plugins.toy import ToyPolicy

RANDOM = [lambda: Smoothed(Victim(), 0.3), Noisy]


def _nothing(observation: Tensor, oracle: Oracle) -> Tensor:
    """A change that is far below what any decision turns on."""
    moved = observation + 1e-7
    moved[..., 0] = observation[..., 0]
    return moved


def _much(observation: Tensor, oracle: Oracle) -> Tensor:
    return observation + torch.where(oracle.radius > 0, 1.9, 0.0) * -observation.sign()


def _some_only(observation: Tensor, oracle: Oracle) -> Tensor:
    """Changes every other episode: the victim is asked about these alone."""
    moved = _nothing(observation, oracle)
    moved[::2] = observation[::2]
    return moved


@pytest.mark.parametrize("policy", RANDOM)
@pytest.mark.parametrize("deed", [_nothing, _some_only])
def test_a_change_of_nothing_changes_no_decision_of_a_random_victim(policy: Any, deed: Any) -> None:
    columns = drive(deed, policy())
    assert (columns["linf"] > 0).any()
    assert float(np.max(columns["changed"])) <= 1 / 90


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
@pytest.mark.parametrize("count", [0, 1, 2, 8])
def test_only_the_episodes_that_were_attacked_count(kind: Any, count: int) -> None:
    def deed(observation: Tensor, oracle: Oracle) -> Tensor:
        moved = _much(observation, oracle)
        moved[count:] = observation[count:]
        return moved

    changed = drive(deed, ToyPolicy(kind, 0).eval(), budget=1.9)["changed"]
    assert (changed[:count] > 0).all()
    assert (changed[count:] == 0).all()


@pytest.mark.parametrize("policy", [Victim, *RANDOM])
def test_a_large_change_changes_decisions(policy: Any) -> None:
    assert float(np.mean(drive(_much, policy(), budget=1.9)["changed"])) > 0.2


@pytest.mark.parametrize("policy", RANDOM)
def test_a_recording_compares_decisions_of_the_same_noise(policy: Any) -> None:
    trace, victim = Trace(range(8)), policy()
    rollout(
        cheats.WORLD.make([cheats.CELL] * 8, action_type="discrete"),
        victim,
        Does(deed=_nothing),
        ObservationThreat(norm="linf", budget=0.1, queries=50),
        cheats.SEEDS,
        facts=cheats.WORLD.facts,
        attack_seed=7,
        trace=trace,
    )
    clean, taken = (np.stack(trace.steps[name]) for name in ("clean_scores", "scores"))
    np.testing.assert_allclose(clean, taken, atol=1e-4)


@pytest.mark.parametrize("policy", RANDOM)
def test_one_observation_is_compared_under_the_same_noise(policy: Any) -> None:
    victim: Policy = policy()
    pair = Pair(
        attack=Chosen(kind="attack", name="does", component=Does(deed=_nothing)),
        defense=choose("defense", "none"),
        victim=choose("victim", "dqn"),
        world=Chosen(kind="world", name="toy", component=cheats.WORLD),
        threat=ObservationThreat(norm="linf", budget=0.1),
    )
    cells = [cheats.CELL] * 300
    session = Session(pair, victim, cells)
    env = cheats.WORLD.make(cells, action_type="discrete")
    rows = env.reset(TensorDict({"seed": torch.arange(300)}, batch_size=[300]))["observation"]
    shown, clean, taken = session.show(rows)
    assert bool((shown.observation != rows).any())
    assert float((clean != taken).float().mean()) < 0.01
