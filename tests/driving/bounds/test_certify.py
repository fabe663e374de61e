from __future__ import annotations

import numpy as np
import pytest
import torch

from cavbench.core.pair import Pair, choose
from cavbench.core.track import Job, track
from cavbench.driving.bounds import networks
from cavbench.driving.sets import Actuator, Held, Latency, Presence, Traffic
from cavbench.driving.threat import ObservationThreat
from cavbench.errors import UserError

STEPS, SEEDS = 25, [1_000_000, 1_000_001]


def pair(attack: str = "pgd", *, defense: str = "sa", victim: str = "dqn", steps: int = STEPS, **threat: float) -> Pair:
    return Pair(
        attack=choose("attack", attack),
        defense=choose("defense", defense),
        victim=choose("victim", victim),
        world=choose("world", "highway", max_steps=steps),
        threat=ObservationThreat(**threat),
    )


def certified(own: Pair, leaves: int = 16):
    cell = own.world.component.axes.cell(lanes=3, density=1.0)
    return track("driving").certify(own, 0, [cell] * 2, SEEDS, leaves)


def test_without_a_budget_everything_is_proven() -> None:
    found = certified(pair("noise", budget=0.0))
    assert (found.linear == 1).all()
    assert (found.changed == 0).all()
    assert np.array_equal(found.bound, found.clean)


def test_no_attack_scores_below_the_certified_score() -> None:
    own = pair("noise", defense="none", budget=0.001, steps=30)
    found = certified(own, leaves=32)
    assert (found.bound > 0).any()
    assert (found.bound <= found.clean).all()
    for attack in ("pgd", "noise", "pessimist"):
        job = Job(
            pair=pair(attack, defense="none", budget=0.001, steps=30),
            training_seed=0,
            attack_seed=3,
            cell=own.world.component.axes.cell(lanes=3, density=1.0),
            seeds=range(SEEDS[0], SEEDS[1] + 1),
        )
        driven = track("driving").drive(job, None, [])
        assert (driven.columns["safe_progress"] >= found.bound - 1e-6).all()


def test_frames_without_an_attack_need_no_proof() -> None:
    found = certified(pair("noise", defense="none", budget=0.1, share=0.0))
    assert np.array_equal(found.bound, found.clean)


def test_more_courses_than_may_be_driven_give_no_score() -> None:
    found = certified(pair("noise", defense="none", budget=0.1), leaves=2)
    assert found.given_up.all()
    assert (found.bound == 0).all()
    assert (found.linear < 0.2).all()


@pytest.mark.parametrize(
    "beyond",
    [
        {"presence": Presence(hidden=2)},
        {"latency": Latency(frames=3)},
        {"held": Held(share=0.1, longest=3)},
        {"actuator": Actuator(replaced=0.5)},
        {"traffic": Traffic(cars=1)},
    ],
    ids=lambda beyond: next(iter(beyond)),
)
def test_an_attack_that_may_change_more_than_values_has_no_bound(beyond: dict[str, object]) -> None:
    """With a budget of 0 everything would be proven, whatever is hidden, late or executed."""
    with pytest.raises(UserError, match=rf"leave out threat\.{next(iter(beyond))}"):
        certified(pair("noise", defense="none", budget=0.0, **beyond))  # type: ignore[arg-type]


def test_a_bound_that_an_attack_refutes_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(self, scores, low, high):
        found = torch.nn.functional.one_hot(scores.argmax(-1), scores.shape[-1]).bool()
        return found, found

    monkeypatch.setattr(networks.BoundedNetwork, "possible", wrong)
    with pytest.raises(UserError, match="ruled out"):
        certified(pair(defense="none", budget=0.1), leaves=0)


@pytest.mark.parametrize(
    ("defense", "victim", "line"),
    [("shield", "dqn", "memory"), ("none", "ddpg", "continuous"), ("none", "planner", "memory")],
)
def test_what_cannot_be_bounded_is_refused(defense: str, victim: str, line: str) -> None:
    with pytest.raises(UserError, match=line):
        certified(pair("noise", defense=defense, victim=victim))
