"""Units that are driven in one batch have the records that each has alone."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.attacks.driving.noise import Noise
from cavbench.attacks.driving.pgd import PGD
from cavbench.attacks.driving.plan import Plan
from cavbench.attacks.driving.rehearse import Rehearse
from cavbench.attacks.driving.zo import ZOSignSGD
from cavbench.core.contracts import Access
from cavbench.core.pair import Pair, choose
from cavbench.core.track import Columns
from cavbench.defenses.driving.atla import AlternatingTraining
from cavbench.defenses.driving.pessimist_q import Believing, PessimistQ
from cavbench.defenses.driving.smoothing import Smoothed
from cavbench.driving import DrivingAttack, ObservationThreat, Oracle, Policy
from cavbench.driving.access import DRAWS
from cavbench.driving.drive import joint
from cavbench.driving.rollout import NotJointError, rollout
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.networks import ActorPolicy, QPolicy
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.world import HighwayWorld
from cavbench.isolation.framework import Snapshot
from cavbench.run.attempt import attempt
from cavbench.run.batches import EPISODES, batches
from cavbench.run.config import plan_of
from cavbench.run.task import Outcome, Task
from cavbench.run.unit import Unit
from cavbench.scenarios import Cell
from tests.driving.cheats import WORLD, Noisy, Victim

PROBES = {"redrawn", "same_answer", "inconsistent", "draws"}
HIGHWAY = HighwayWorld(max_steps=40)
CELLS = [
    AXES.cell(lanes=3, density=2.0),
    AXES.cell(lanes=4, density=1.0, weather="rain"),
    AXES.cell(lanes=5, density=2.0),
]
SEEDS = range(1_000_000, 1_000_007)


def driven(attack: DrivingAttack | None, policy: Policy, units: Sequence[int], share: float = 1.0) -> Columns:
    """The measurements of some of three units."""
    cells = [CELLS[unit] for unit in units for _ in SEEDS]
    return rollout(
        HIGHWAY.make(cells, action_type=policy.action_type),
        policy,
        attack,
        ObservationThreat(norm="linf", budget=0.1, access="dynamics", share=share),
        list(SEEDS) * len(units),
        facts=HIGHWAY.facts,
        attack_seed=[unit for unit in units for _ in SEEDS],
        dynamics=HIGHWAY.dynamics(cells, policy.action_type),
    )


@dataclass(frozen=True, kw_only=True)
class Draws(DrivingAttack):
    """Says that it is joint, and draws from the generator of the process."""

    access: ClassVar[Access] = "oblivious"
    joint: ClassVar[bool] = True

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        return oracle.project(observation + torch.rand(observation.shape))


def gradients_depend_on_the_batch(policy: Policy) -> bool:
    """Whether this processor rounds the gradient of some observations otherwise if there are fewer of them."""

    def slope(observation: Tensor) -> Tensor:
        leaf = observation.clone().requires_grad_(True)
        (gradient,) = torch.autograd.grad(policy(leaf).sum(), leaf)
        return gradient

    cells = [cell for cell in CELLS for _ in SEEDS]
    env = HIGHWAY.make(cells, action_type=policy.action_type)
    seeds = torch.tensor(list(SEEDS) * len(CELLS))
    seen = env.reset(TensorDict({"seed": seeds}, batch_size=[len(cells)]))["observation"]
    whole = slope(seen)
    return any(not torch.equal(slope(seen[-size:]), whole[-size:]) for size in range(1, len(cells)))


ATTACKS: dict[str, DrivingAttack | None] = {
    "none": None,
    "uniform": Noise(),
    "gaussian": Noise(distribution="gaussian"),
    "pgd": PGD(),
    "pgd at a preference gap": PGD(gap=0.3, restarts=2, steps=3),
    "plan": Plan(steps=4),
    "zo": ZOSignSGD(),
    "zo from a random start": ZOSignSGD(random_start=True, early_stop=False),
    "zo of the thesis": ZOSignSGD(objective="thesis", directions=20),
}


@pytest.mark.parametrize("name", ATTACKS)
@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_units_in_one_batch_have_the_records_that_each_has_alone(name: str, kind: str) -> None:
    torch.manual_seed(0)
    policy: Policy = QPolicy(5, 5, 128) if kind == "discrete" else ActorPolicy(5, 64, 0.1)
    policy.eval().requires_grad_(False)
    attack = ATTACKS[name]
    if attack and attack.access in ("gradients", "dynamics") and gradients_depend_on_the_batch(policy):
        # A product of matrices rounds by its size on some processors; a run then drives the units one by one.
        with pytest.raises(NotJointError):
            driven(attack, policy, (0, 1, 2), share=0.7)
        return
    together = driven(attack, policy, (0, 1, 2), share=0.7)
    alone = [driven(attack, policy, (unit,), share=0.7) for unit in range(3)]
    for column in set(together) - PROBES - {"attack_ms"}:
        np.testing.assert_array_equal(together[column], np.concatenate([one[column] for one in alone]), column)


@pytest.mark.parametrize(
    ("name", "defense"),
    [*((name, None) for name in ("none", "pgd", "plan", "zo", "rehearse")), ("pgd", PessimistQ(corners=3))],
)
def test_units_of_a_smoothed_victim_in_one_batch_have_the_records_that_each_has_alone(
    name: str, defense: PessimistQ | None
) -> None:
    """Its noise belongs to the episode: not to the batch, nor to how many others there are."""
    torch.manual_seed(0)
    policy: Policy = Smoothed(QPolicy(5, 5, 32).eval().requires_grad_(False), 0.05)
    policy = policy if defense is None else Believing(defense, policy, HIGHWAY.facts)
    attack = {**ATTACKS, "plan": Plan(steps=2), "pgd": PGD(steps=2), "rehearse": Rehearse(horizon=1.0)}[name]
    together = driven(attack, policy, (0, 1, 2), share=0.7)
    alone = [driven(attack, policy, (unit,), share=0.7) for unit in range(3)]
    for column in set(together) - PROBES - {"attack_ms"}:
        np.testing.assert_array_equal(together[column], np.concatenate([one[column] for one in alone]), column)
    assert (together["queries_max"] % DRAWS == 0).all()


@pytest.mark.parametrize("name", ["none", "pgd", "pgd at a preference gap", "plan", "rehearse"])
def test_units_of_a_driver_with_a_memory_in_one_batch_have_the_records_that_each_has_alone(name: str) -> None:
    policy = AlternatingTraining().load(DQN(), 0, HIGHWAY.facts)
    attack = {**ATTACKS, "plan": Plan(steps=2), "rehearse": Rehearse(horizon=1.0)}[name]
    together = driven(attack, policy, (0, 1), share=0.7)
    alone = [driven(attack, policy, (unit,), share=0.7) for unit in range(2)]
    for column in set(together) - PROBES - {"attack_ms"}:
        np.testing.assert_array_equal(together[column], np.concatenate([one[column] for one in alone]), column)


class WithTheBatch(Victim):
    def forward(self, observation: Tensor) -> Tensor:
        return super().forward(observation) + observation.mean()


@pytest.mark.parametrize(
    ("attack", "policy"),
    [(None, WithTheBatch()), (Noise(), Noisy()), (Draws(), Victim())],
    ids=["batch", "victim", "attack"],
)
def test_what_would_have_other_records_in_a_batch_is_driven_alone(attack: DrivingAttack | None, policy: Policy) -> None:
    cells = [Cell(lanes=3, density=density, weather="clear") for density in (1.0, 2.0) for _ in SEEDS]
    with pytest.raises(NotJointError):
        rollout(
            WORLD.make(cells, action_type="discrete"),
            policy,
            attack,
            ObservationThreat(),
            list(SEEDS) * 2,
            facts=WORLD.facts,
            attack_seed=[unit for unit in (0, 1) for _ in SEEDS],
        )


def units(attack: str, count: int, victim: str = "dqn", **seeds: Any) -> list[Unit]:
    pair = Pair(
        attack=choose("attack", attack),
        defense=choose("defense", "none"),
        victim=choose("victim", victim),
        world=choose("world", "highway"),
        threat=ObservationThreat(access="dynamics"),
    )
    cells = [AXES.cell(lanes=lanes, density=1.0) for lanes in range(2, 2 + count)]
    return [
        Unit(pair=pair, training_seed=0, weights_sha256="", cell=cell, **{"seeds": SEEDS, **seeds}) for cell in cells
    ]


def batched(some: Sequence[Unit], *recorded: str, workers: int = 1) -> list[list[Unit]]:
    tasks = [Task(unit=unit) for unit in some]
    return [[task.unit for task in batch] for batch in batches(tasks, recorded, workers=workers)]


def test_alike_units_come_together_and_all_workers_have_enough_to_do() -> None:
    zo, noise, pessimist = (units(attack, 6) for attack in ("zo", "noise", "pessimist"))
    assert [joint(one[0].pair) for one in (zo, noise, pessimist)] == [True, True, False]
    works = [unit for three in zip(zo, noise, pessimist, strict=True) for unit in three]
    found = batched(works, workers=2)
    assert sorted(map(len, found)) == [1] * 6 + [2] * 6
    assert sorted(map(str, works)) == sorted(str(unit) for batch in found for unit in batch)
    assert {len({(unit.pair.id, unit.training_seed) for unit in batch}) for batch in found} == {1}


def test_a_batch_is_not_larger_than_the_cache_and_holds_no_recorded_unit() -> None:
    many = units("zo", 6, seeds=range(EPISODES // 2)) * 2
    assert {len(batch) for batch in batched(many)} == {2}
    few = units("zo", 6, seeds=range(10)) * 2
    sizes = [len(batch) for batch in batched(few, few[0].fingerprint)]
    assert sorted(sizes) == [1, 1, 1, 3, 3, 3]


def carried_out(task: Task) -> Outcome:
    outcome = attempt(task, lambda *news: None, Snapshot())
    assert not outcome.failed
    return outcome


def test_a_task_of_several_units_has_the_outcome_of_each() -> None:
    works = units("noise", 3, seeds=range(1_000_000, 1_000_002))
    task = Task(unit=works[0], others=works[1:])
    outcome = carried_out(task)
    alone = [carried_out(Task(unit=unit)) for unit in works]
    timed = {"attack_ms", "wall_s", "created_at", "entropy"}
    for one, other in zip((outcome, *outcome.others), alone, strict=True):
        assert one.records is not None
        assert other.records is not None
        same = [name for name in one.records.column_names if name not in PROBES | timed]
        assert one.records.select(same).to_pylist() == other.records.select(same).to_pylist()


def test_an_outcome_survives_the_way_from_a_worker() -> None:
    outcome = carried_out(Task(unit=units("noise", 1, seeds=range(1_000_000, 1_000_002))[0]))
    assert outcome.records is not None
    sent = pickle.dumps(replace(outcome, others=[outcome, Outcome(wall_s=1.0, artefact=b"patch")]))
    found = pickle.loads(sent)
    assert found.records.equals(outcome.records, check_metadata=True)
    assert found.others[0].records.equals(outcome.records)
    assert (found.others[1].records, found.others[1].artefact) == (None, b"patch")


def test_a_run_without_recordings_drives_its_units_in_batches() -> None:
    words = (
        "attack=noise",
        "lanes=3,4,5",
        "density=1,2",
        "weather=clear",
        "seeds=0",
        "reference=false",
        "episodes=100",
    )
    sizes = []
    for record in ("record=0", "record=1"):
        plan = plan_of([*words, record])
        some = plan.units({task.unit.networks: ("", "") for task in plan.loadings})
        sizes.append({len(batch) for batch in batched(some, *plan.recorded(some))})
    assert sizes == [{3}, {1, 3}]
