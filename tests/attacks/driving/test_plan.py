"""The planning attack: it knows the rules of motion and never the hidden state, and it finds what ends worst."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.attacks.driving.plan import Plan
from cavbench.attacks.driving.rehearse import Rehearse
from cavbench.core.pair import choose
from cavbench.driving import ActionType, DrivingAttack, ObservationThreat, Policy
from cavbench.driving.attacker import Attacker
from cavbench.driving.victim import CountedPolicy
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.batched import BatchedHighway
from cavbench.envs.highway.forecast import FIELDS
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from tests.attacks.driving.victims import victim

WORLD, CELL = HighwayWorld(), AXES.cell(lanes=4, density=1.0)
THREAT = ObservationThreat(access="dynamics")
HIDDEN = {"timer": 0.9, "delta": 3.5, "target_speed": 31.0, "target_lane": 2}
FASTER, SLOWER = 3, 4


def started(batch: int, action_type: ActionType = "discrete") -> tuple[BatchedHighway, Tensor]:
    """An environment of `batch` episodes on the seeds that tune attacks, and its first observation."""
    env = WORLD.make([CELL] * batch, action_type=action_type)
    assert isinstance(env, BatchedHighway)
    return env, env.reset(TensorDict({"seed": torch.arange(3_000_000, 3_000_000 + batch)}, [batch]))["observation"]


def attacker(
    policy: Policy, attack: DrivingAttack | None = None, threat: ObservationThreat = THREAT, episodes: int = 3
) -> Attacker:
    dynamics = WORLD.dynamics([CELL] * episodes, policy.action_type)
    return Attacker(
        attack or Plan(horizon=1.0), CountedPolicy(policy), threat, WORLD.features, seed=0, dynamics=dynamics
    )


@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
@pytest.mark.parametrize("attack", [Plan(horizon=1.0), Rehearse(horizon=0.5, renew=2)])
def test_hidden_state_cannot_reach_it(action_type: ActionType, attack: DrivingAttack) -> None:
    """Two runs with equal observations and different hidden state give equal perturbations, frame by frame."""
    env, observation = started(3, action_type)
    other, same = started(3, action_type)
    for name, value in HIDDEN.items():
        other.engine.vehicles[name][:, 1:] = value
    other.engine.vehicles["timer"][:, 1::2] = 0.0
    other.engine.episodes["steps"] = 7
    assert torch.equal(observation, same)
    policy = victim(action_type)
    first, second = attacker(policy, attack), attacker(policy, attack)
    everyone = torch.ones(3, dtype=torch.bool)
    for _ in range(4):
        shown, again = (one.show(observation, everyone, None).observation for one in (first, second))
        assert torch.equal(shown, again)
        assert not torch.equal(shown, observation)
        # The same observations to both; the worlds behind them differ.
        env.step(TensorDict({"action": policy.decide(shown)}, [3]))
        other.step(TensorDict({"action": policy.decide(shown)}, [3]))
        observation = torch.from_numpy(env.engine.observation.copy())
    assert not np.array_equal(env.engine.vehicles["target_speed"], other.engine.vehicles["target_speed"])


def test_it_is_given_nothing_that_belongs_to_an_episode() -> None:
    dynamics = WORLD.dynamics([CELL] * 2, "discrete")
    env, _ = started(2)
    held = [value for value in vars(dynamics).values() if isinstance(value, np.ndarray)]
    assert not any(np.shares_memory(array, env.engine.vehicles) for array in held)
    assert not any(isinstance(value, type(env.engine)) for value in vars(dynamics).values())


def test_access_to_the_dynamics_must_be_declared_and_allowed() -> None:
    with pytest.raises(UserError, match="needs access 'dynamics', the threat model allows 'gradients'"):
        attacker(victim("discrete"), threat=ObservationThreat())
    none = Attacker(Plan(), CountedPolicy(victim("discrete")), THREAT, WORLD.features, seed=0)
    with pytest.raises(UserError, match="dynamics of the world, which this world does not offer"):
        none.show(started(1)[1], torch.ones(1, dtype=torch.bool), None)
    pair = choose("attack", "pgd").component
    weaker = Attacker(
        pair,
        CountedPolicy(victim("discrete")),
        THREAT,
        WORLD.features,
        seed=0,
        dynamics=WORLD.dynamics([CELL], "discrete"),
    )
    with pytest.raises(UserError, match="used access 'dynamics', but declares only 'gradients'"):
        _ = weaker.enforcer.begin(started(1)[1]).dynamics


def test_the_belief_follows_the_traffic() -> None:
    """After 60 frames of driving every tracked car in view has its true target lane, and the ego its target speed, too."""
    env, observation = started(6)
    dynamics = WORLD.dynamics([CELL] * 6, "discrete")
    belief = dynamics.unknown()
    generator = torch.Generator().manual_seed(0)
    for _ in range(60):
        belief = dynamics.believe(observation, belief)
        action = torch.randint(0, 5, (6,), generator=generator)
        # What is believed is compared with the state in which the observation was taken.
        truth, done = env.engine.vehicles.copy(), env.engine.flags[0].copy()
        env.step(TensorDict({"action": action}, [6]))
        observation = torch.from_numpy(env.engine.observation.copy())
    alive = np.flatnonzero(~done)
    assert len(alive)
    compared = 0
    for episode in alive:
        ego = truth[episode, 0]
        assert belief["target_lane"][episode, 0] == ego["target_lane"]
        assert belief["target_speed"][episode, 0] == pytest.approx(ego["target_speed"])
        for car in range(1, int(belief["count"][episode])):
            ahead = float(belief["x"][episode, car] - belief["x"][episode, 0])
            if not -9 < ahead < 90:
                continue
            off = np.abs(truth[episode]["x"][1:] - ego["x"] - ahead) + np.abs(
                truth[episode]["y"][1:] - float(belief["y"][episode, car])
            )
            if off.min() < 0.01:
                compared += 1
                assert truth[episode]["target_lane"][1 + off.argmin()] == belief["target_lane"][episode, car]
    assert compared > 10


def test_a_forecast_from_the_true_state_is_what_happens() -> None:
    """With nothing hidden a plan ends where the environment ends it: both are the same engine, but for far cars."""
    env, observation = started(40)
    dynamics = WORLD.dynamics([CELL] * 40, "discrete")
    belief = dynamics.believe(observation, dynamics.unknown())
    told = {name: torch.from_numpy(env.engine.vehicles[name].astype(np.float64)) for name in FIELDS}
    belief.update({**told, "count": torch.full((40,), env.engine.vehicles.shape[1])})
    found = dynamics.roll(belief, torch.full((1, 75), FASTER)).failed[:, 0].numpy()
    ended = np.full(40, 75)
    for step in range(75):
        alive = ~env.engine.flags[0]
        env.step(TensorDict({"action": torch.full((40,), FASTER)}, [40]))
        ended[alive & env.engine.flags[0]] = step
    assert (ended < 75).sum() >= 10
    assert np.mean(np.abs(found - ended) <= 1) >= 0.9


def test_it_leads_the_victim_into_the_action_that_crashes() -> None:
    """A victim of which every action can be induced, right behind a slow car: the attack makes it speed up, not brake."""

    class Obedient(Policy):
        """Q-values that the ego's lateral velocity decides: any action within the budget."""

        action_type: ActionType = "discrete"

        def forward(self, observation: Tensor) -> Tensor:
            push = observation[..., 0, 4] * 20
            centres = torch.tensor([-0.15, 0.0, 0.15, -0.075, 0.075])
            return -(push[..., None] - centres).square()

    policy = Obedient()
    observation = torch.zeros(1, 10, 5)
    # The ego at 25 m/s in lane 0; a car 12 m ahead at 15 m/s. The next lane is free.
    observation[0, 0] = torch.tensor([1.0, 1.0, 0.0, 25 / 40, 0.0])
    observation[0, 1] = torch.tensor([1.0, 0.16, 0.0, -10 / 40, 0.0])
    assert int(policy.decide(observation)) == 1
    at_work = attacker(policy, Plan(), episodes=1)
    shown = at_work.show(observation, torch.ones(1, dtype=torch.bool), None)
    worth = at_work.state["worth"][0]
    assert int(worth.argmin()) != SLOWER
    assert int(policy.decide(shown.observation)) == int(worth.argmin())


@pytest.mark.parametrize("queries", [0, 3, 4, 20, 1000])
@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
@pytest.mark.parametrize("attack", [Plan(horizon=1.0), Rehearse(horizon=1.0)])
def test_it_keeps_to_the_query_budget(queries: int, action_type: ActionType, attack: DrivingAttack) -> None:
    policy, threat = victim(action_type), ObservationThreat(access="dynamics", queries=queries)
    _, observation = started(2, action_type)
    shown = attacker(policy, attack, threat, episodes=2).show(observation, torch.ones(2, dtype=torch.bool), None)
    assert int(shown.queries.max()) <= queries


def test_with_a_gap_it_attacks_only_frames_that_matter() -> None:
    policy = victim("discrete")
    env, observation = started(8)
    everyone = torch.ones(8, dtype=torch.bool)
    always, choosy, never = (attacker(policy, Plan(horizon=2.0, gap=gap), episodes=8) for gap in (0.0, 0.1, 1.0))
    touched = torch.zeros(3)
    for _ in range(6):
        for number, one in enumerate((always, choosy, never)):
            shown = one.show(observation, everyone, None).observation
            touched[number] += (shown != observation).flatten(1).any(1).sum()
        observation = env.step(TensorDict({"action": policy.decide(observation)}, [8]))["next", "observation"]
    assert touched[0] > touched[1] >= touched[2] == 0
