"""The rehearsing attack: its simulation is the world, the victim in it is the victim, and it hurts a careful driver."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from cavbench.attacks.driving.rehearse import SIGNS, shown
from cavbench.core.pair import choose
from cavbench.driving import ObservationThreat, Oracle, Policy
from cavbench.driving.access import Enforcer
from cavbench.driving.dynamics import Dynamics
from cavbench.driving.intervals.motion_kernels import SPEED
from cavbench.driving.rollout import rollout
from cavbench.driving.victim import CountedPolicy
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.batched import BatchedHighway
from cavbench.envs.highway.forecast import FIELDS
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError

WORLD, CELL = HighwayWorld(), AXES.cell(lanes=3, density=2.0)
THREAT = ObservationThreat(access="dynamics")
SEEDS = range(3_000_000, 3_000_006)


def started(batch: int) -> BatchedHighway:
    env = WORLD.make([CELL] * batch, action_type="discrete")
    assert isinstance(env, BatchedHighway)
    env.reset(TensorDict({"seed": torch.tensor(SEEDS[:batch])}, [batch]))
    return env


def tracked_planner() -> Policy:
    victim = choose("victim", "planner").component
    policy: Policy = choose("defense", "tracker").component.load(victim, 0, WORLD.facts)
    return policy


def oracle_of(policy: Policy, env: BatchedHighway, queries: int = 1000) -> tuple[Enforcer, Oracle]:
    dynamics = WORLD.dynamics([CELL] * env.batch_size[0], "discrete")
    threat = ObservationThreat(access="dynamics", queries=queries)
    enforcer = Enforcer(CountedPolicy(policy), threat, "dynamics", WORLD.features, torch.Generator(), dynamics)
    state = policy.initial(torch.arange(env.batch_size[0]))
    return enforcer, enforcer.begin(torch.from_numpy(env.engine.observation.copy()), state)


def test_a_rehearsal_from_the_true_state_is_what_happens() -> None:
    env, copies = started(6), 2
    dynamics = WORLD.dynamics([CELL] * 6, "discrete")
    belief = dynamics.believe(torch.from_numpy(env.engine.observation.copy()), dynamics.unknown())
    told = {name: torch.from_numpy(env.engine.vehicles[name].astype(np.float64)) for name in FIELDS}
    belief.update({**told, "count": torch.full((6,), env.engine.vehicles.shape[1])})
    world = dynamics.rehearsal(belief, copies)
    generator = torch.Generator().manual_seed(0)
    for _ in range(60):
        np.testing.assert_allclose(world.observation[1], env.engine.observation, atol=2e-6)
        assert torch.equal(world.observation[0], world.observation[1])
        action = torch.randint(0, 5, (6,), generator=generator)
        world.step(action.expand(copies, -1))
        env.step(TensorDict({"action": action}, [6]))
    assert torch.equal(world.failed[0], torch.from_numpy(env.engine.flags[1]))


def test_the_rehearsed_victim_is_the_victim_and_the_run_goes_on_from_its_own_state() -> None:
    env, policy = started(3), tracked_planner()
    enforcer, oracle = oracle_of(policy, env)
    observation = oracle.observation
    before = oracle.scores(observation)
    imagined = oracle.imagined(2)
    action, after = oracle.rehearse(observation.expand(2, -1, -1, -1), imagined)
    state = policy.initial(torch.arange(3))
    wanted = policy.decide(observation, state)
    assert torch.equal(action, wanted.expand(2, -1))
    assert after is not None
    assert imagined is not None
    assert (after == policy.advance(observation, wanted, state).expand(2, 3).reshape(6)).all()
    imagined["ego"][:, SPEED] += 5
    assert torch.equal(oracle.scores(observation), before)
    assert enforcer.spent.tolist() == [4, 4, 4]
    enforcer.close()


def test_every_lie_is_in_the_perturbation_set() -> None:
    env = started(4)
    _, oracle = oracle_of(tracked_planner(), env)
    told = shown(oracle.observation.expand(8, -1, -1, -1), SIGNS[:, None].expand(-1, 4, -1), oracle)
    assert torch.equal(oracle.project(told), told)
    assert len({tuple(each.flatten().tolist()) for each in told}) == len(SIGNS)


def test_a_world_without_a_simulation_is_refused_in_one_line() -> None:
    dynamics = WORLD.dynamics([CELL], "discrete")
    with pytest.raises(UserError, match="a simulation of the world step by step, which this world does not offer"):
        Dynamics.rehearsal(dynamics, dynamics.unknown(), 2)


@pytest.mark.slow
def test_it_costs_a_careful_driver_more_than_what_looks_one_step_ahead() -> None:
    def score(attack: str) -> float:
        cells = [CELL] * len(SEEDS)
        columns = rollout(
            WORLD.make(cells, action_type="discrete"),
            choose("victim", "planner").component.load(0, WORLD.facts),
            choose("attack", attack).component,
            THREAT,
            list(SEEDS),
            facts=WORLD.facts,
            attack_seed=[0] * len(SEEDS),
            dynamics=WORLD.dynamics(cells, "discrete"),
            entropy=0,
        )
        return float(columns["safe_progress"].mean())

    assert score("rehearse") < score("pessimist") - 0.02
