"""The platoon moves as the closed form of its controllers says, and its episodes do not depend on each other."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from cavbench.driving import Control, ObservationThreat
from cavbench.driving.rollout import rollout
from cavbench.driving.victims.cacc import ACC, CACC
from cavbench.driving.victims.path import PATH
from cavbench.envs.platoon.axes import CYCLES, PLATOON_V1
from cavbench.envs.platoon.engine import PlatoonEngine
from cavbench.envs.platoon.kernels import TIMEOUT
from cavbench.envs.platoon.world import PlatoonWorld
from cavbench.errors import UserError
from cavbench.scenarios import Cell
from tests.envs.platoon.transfer import gain, worst

OMEGAS = (0.2, 0.4, 0.8, 1.5)
PUBLISHED = {"headway": 0.7, "kp": 0.2, "kd": 0.7}


def cell(place: int = 2, cycle: str = "wave", loss: float = 0.0) -> Cell:
    return PlatoonWorld().axes.cell(place=place, cycle=cycle, loss=loss)


def measured(followers: str) -> NDArray[np.float64]:
    """[OMEGAS, 3] what three followers make of a sine of the car ahead, from the engine."""
    world = PlatoonWorld(followers=followers, noise=0.0, max_steps=2000)  # type: ignore[arg-type]
    engine = PlatoonEngine(world.configuration([cell(place=1)] * len(OMEGAS), Control(action_type="continuous")))
    engine.reset(np.arange(len(OMEGAS)), np.arange(len(OMEGAS)))
    times = np.arange(2000) * 0.1
    engine.platoons.leader[:] = 0.5 * np.cos(np.outer(OMEGAS, times))
    # The driven car is a leader, too: the followers behind it are the world's. It repeats what the leader does.
    heights = []
    for step in range(2000):
        engine.step(engine.platoons.leader[:, step : step + 1] / 8)
        heights.append(engine.platoons.a[:, 1:4].copy())
    late = np.abs(np.fft.rfft(np.stack(heights)[1000:] * np.hanning(1000)[:, None, None], axis=0)).max(0)
    return late[:, 1:] / late[:, :-1]


@pytest.mark.parametrize(("followers", "told"), [("cacc", True), ("acc", False)])
def test_the_followers_amplify_as_their_transfer_function_says(followers: str, told: bool) -> None:
    wanted = [gain(omega, **PUBLISHED, told=told) for omega in OMEGAS]
    assert measured(followers) == pytest.approx(np.array(wanted)[:, None].repeat(2, 1), rel=0.02)


def test_with_messages_the_published_gains_are_string_stable_and_without_them_they_are_not() -> None:
    assert worst(**PUBLISHED, told=True) <= 1
    assert worst(**PUBLISHED, told=False) > 1.2
    # At low frequencies ACC needs a headway of sqrt(2 / kp), 3.16 s.
    assert worst(3.0, 0.2, 0.7, told=False) > 1 >= worst(3.2, 0.2, 0.7, told=False)
    default = ACC()
    assert worst(default.headway, default.kp, default.kd, told=False) <= 1


def columns(world: PlatoonWorld, victim: CACC | ACC | PATH, cells: list[Cell]) -> dict[str, NDArray[np.generic]]:
    """The measurements of episodes without an attack."""
    env = world.make(cells, action_type="continuous")
    policy = victim.load(0, world.facts)
    seeds = list(range(len(cells)))
    return rollout(env, policy, None, ObservationThreat(), seeds, facts=world.facts, attack_seed=0)


def test_the_records_say_who_is_string_stable() -> None:
    """Sines with the frequency at which ACC amplifies most are in the cycle `wave`."""
    found = {
        name: columns(PlatoonWorld(noise=0.0), victim, [cell(place=5)] * 6)
        for name, victim in {"cacc": CACC(), "acc": ACC(**PUBLISHED)}.items()
    }
    # The window of 40 s does not hold whole waves.
    assert (found["cacc"]["amplification"] < 1.005).all()
    assert (found["cacc"]["amplification_peak"] < 1.01).all()
    assert found["acc"]["amplification"].max() > 1.1
    assert not found["cacc"]["crashed"].any()
    assert found["cacc"]["min_time_gap_s"] == pytest.approx(0.77, abs=0.03)


def test_a_victim_drives_as_the_follower_of_the_world_with_its_gains() -> None:
    world = PlatoonWorld(noise=0.0, behind=0)
    engine = PlatoonEngine(
        world.configuration([cell(2, "braking"), cell(1, "braking")], Control(action_type="continuous"))
    )
    engine.reset(np.array([0, 1]), np.array([7, 7]))
    policy = CACC().load(0, world.facts)
    state = policy.initial(torch.arange(2))
    for _ in range(300):
        shown = torch.from_numpy(engine.observation.copy())
        action = policy.decide(shown, state)
        state = policy.advance(shown, action, state)
        engine.step(action.numpy())
        # Car 1 follows by the world's law in the first platoon, and by the victim in the second one.
        assert engine.platoons.x[0, 1] == pytest.approx(engine.platoons.x[1, 1], abs=0.01)


def test_no_follower_of_the_world_crashes_in_its_grid_and_perfect_information_is_the_best() -> None:
    cells = PLATOON_V1.cells()
    scores = {}
    for driver in ("clairvoyant", "idm"):
        engine = PlatoonEngine(PlatoonWorld().configuration(cells, Control(driver=driver)))  # type: ignore[arg-type]
        engine.reset(np.arange(len(cells)), np.arange(len(cells)))
        progress = np.zeros(len(cells))
        for _ in range(600):
            engine.step(np.zeros(len(cells)))
            progress += engine.numbers[:, 1]
            gaps = -np.diff(engine.platoons.x, axis=1) - 5
            there = np.arange(1, engine.platoons.x.shape[1]) < engine.platoons.cars[:, None]
            assert (gaps[there] > 0.5).all()
        scores[driver] = progress / 600
    assert (scores["clairvoyant"] > 0.98).all()
    assert (scores["clairvoyant"] > scores["idm"] + 0.2).all()


def test_what_is_heard_is_true_and_is_lost_as_often_as_the_axis_says() -> None:
    cells = [cell(8, "motorway", loss) for loss in (0.0, 0.3, 1.0)]
    world = PlatoonWorld(noise=0.0)
    engine = PlatoonEngine(world.configuration(cells, Control(action_type="continuous")))
    engine.reset(np.arange(3), np.zeros(3, np.int64))
    fresh = np.zeros(3)
    for _ in range(200):
        engine.step(np.zeros((3, 1)))
        shown = engine.observation
        fresh += (shown[:, 2:, 4] == -1).sum(1)
        platoons = engine.platoons
        distance = platoons.x[0, 7::-1] - platoons.x[0, 8]
        assert shown[0, 2:, 1] * 400 == pytest.approx(distance, abs=1e-3)
        assert shown[0, 2:, 3] * 10 == pytest.approx(platoons.u[0, 7::-1], abs=1e-5)
        # An old message is where the sender was, seen from here.
        old = (shown[1, 2:, 0] > 0) & (shown[1, 2:, 4] > -1)
        assert (shown[1, 2:, 1][old] * 400 < (platoons.x[1, 7::-1] - platoons.x[1, 8])[old] + 1e-3).all()
    assert (engine.observation[2, 2:] == 0).all()
    assert TIMEOUT == 10
    assert fresh / 1600 == pytest.approx([1, 0.7, 0], abs=0.04)


def test_an_episode_depends_on_its_seed_alone() -> None:
    """Not on the place in a batch, the other cells, or what was driven before."""
    world = PlatoonWorld()
    cells = [cell(1, "braking", 0.3), cell(8, "stop_and_go", 0.1), cell(3, "motorway", 0.5)]

    def driven(order: list[int], seeds: list[int]) -> NDArray[np.float32]:
        env = world.make([cells[one] for one in order], action_type="continuous")
        td = env.reset(TensorDict({"seed": torch.tensor(seeds)}, batch_size=[len(order)]))
        policy = CACC().load(0, world.facts)
        state = policy.initial(torch.arange(len(order)))
        found = []
        for _ in range(120):
            action = policy.decide(td["observation"], state)
            state = policy.advance(td["observation"], action, state)
            td = env.step(td.set("action", action))["next"]
            found.append(td["observation"].numpy())
        return np.stack(found)

    together = driven([0, 1, 2], [5, 6, 7])
    assert np.array_equal(together[:, 1:2], driven([1], [6]))
    assert np.array_equal(together[:, [2, 0]], driven([2, 0], [7, 5]))
    assert not np.array_equal(together[:, 1:2], driven([1], [8]))


def test_an_episode_that_ended_stays_as_it_is() -> None:
    env = PlatoonWorld(max_steps=30).make([cell()], action_type="continuous")
    td = env.reset(TensorDict({"seed": torch.tensor([1])}, batch_size=[1]))
    for _ in range(30):
        td = env.step(td.set("action", torch.zeros(1, 1)))["next"]
    assert bool(td["truncated"])
    assert not bool(td["terminated"])
    after = env.step(td.set("action", torch.ones(1, 1)))["next"]
    assert torch.equal(after["observation"], td["observation"])
    assert float(after["reward"]) == 0


def test_a_held_action_is_one_of_several_decisions() -> None:
    once, held = (
        PlatoonEngine(PlatoonWorld().configuration([cell()], Control(action_type="continuous", action_repeat=repeat)))
        for repeat in (1, 4)
    )
    for engine in (once, held):
        engine.reset(np.array([0]), np.array([3]))
    progress = 0.0
    for _ in range(4):
        once.step(np.array([[0.1]]))
        progress += once.numbers[0, 1]
    held.step(np.array([[0.1]]))
    assert np.array_equal(once.observation, held.observation)
    assert held.numbers[0, 1] == pytest.approx(progress)


def test_path_keeps_its_distance_whatever_the_speed() -> None:
    found = columns(PlatoonWorld(), PATH(), [cell(3, cycle) for cycle in CYCLES])
    assert not found["crashed"].any()
    assert (found["min_time_gap_s"] < 0.5).all()
    assert (found["amplification"] < 1.05).all()


def test_a_victim_that_listens_is_refused_in_a_world_without_messages() -> None:
    from cavbench.envs.highway.world import HighwayWorld

    with pytest.raises(UserError, match="world=platoon"):
        CACC().load(0, HighwayWorld().facts)
    with pytest.raises(ValueError, match="headway"):
        PlatoonWorld(headway=0.1)
    assert math.isclose(PlatoonWorld().decision_hz, 10)
