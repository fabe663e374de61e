"""The set `messages`: lies stay in their bounds, old messages are what was said then, and the run says how much."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from cavbench.attacks.driving.false_data import FalseData
from cavbench.core.contracts import Access
from cavbench.driving import DrivingAttack, Forgery, ObservationThreat, Oracle, State
from cavbench.driving.forging import Forging
from cavbench.driving.rollout import Trace, rollout
from cavbench.driving.victims.cacc import CACC
from cavbench.envs.platoon.world import FEATURES, PlatoonWorld
from cavbench.errors import UserError

X, VX, AX, AGE = 1, 2, 3, 4
STEPS = 60
WORLD = PlatoonWorld(max_steps=STEPS)


def threat(**messages: Any) -> ObservationThreat:
    return ObservationThreat(messages=messages)  # type: ignore[arg-type]


def driven(
    attack: DrivingAttack | None,
    allowed: ObservationThreat,
    *,
    loss: float = 0.0,
    noise: float = 0.0,
    seeds: tuple[int, ...] = (1, 2),
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The measurements of an attack on `cacc` in the braking cycle, and every step of it, [T, B, ...] each."""
    world = PlatoonWorld(max_steps=STEPS, noise=noise)
    env = world.make([world.axes.cell(place=3, cycle="braking", loss=loss)] * len(seeds), action_type="continuous")
    trace = Trace(range(len(seeds)))
    policy = CACC().load(0, world.facts)
    columns = rollout(env, policy, attack, allowed, seeds, facts=world.facts, attack_seed=3, trace=trace)
    return columns, {name: torch.as_tensor(steps) for name, steps in ((n, _stacked(s)) for n, s in trace.steps.items())}


def _stacked(steps: list[Any]) -> Any:
    return torch.stack([torch.as_tensor(one) for one in steps])


@dataclass(frozen=True, kw_only=True, eq=False)
class Answers(DrivingAttack):
    """Answers what a function says of the observation, from a step on."""

    access: ClassVar[Access] = "oblivious"

    answer: Callable[[Tensor], Forgery]
    first: int = 0

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        return TensorDict({"step": torch.zeros(len(observation))}, batch_size=[len(observation)])

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor | Forgery, State]:
        assert state is not None
        begun = bool((state["step"] >= self.first).all())
        state["step"] = state["step"] + 1
        return self.answer(observation) if begun else observation, state


def forging(allowed: ObservationThreat) -> Forging:
    return Forging(allowed, FEATURES, 0.1, STEPS, [(2, 0)])


def road() -> Tensor:
    """Two platoons as one of them may look: the own car at 20 m/s, radar, and three senders."""
    rows = torch.zeros(2, 10, 5)
    rows[:, 0] = torch.tensor([1.0, 0.0, 0.4, 0.0, -1.0])
    for row, x in ((1, 20.0), (2, 20.0), (3, 40.0), (4, 60.0)):
        rows[:, row] = torch.tensor([1.0, x / 400, 0.02, 0.1 if row > 1 else 0.0, -1.0])
    return rows


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.floats(0, 400), st.floats(0, 50), st.floats(0, 20), st.integers(1, 3))
def test_whatever_is_forged_is_within_the_set(seed: int, x: float, v: float, a: float, senders: int) -> None:
    if not (x or v or a):
        x = 1.0
    run, truth = forging(threat(senders=senders, position=x, speed=v, acceleration=a)), road()
    run.see(truth)
    wild = 3 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(seed))
    wild[:, 2 + senders :] = torch.nan
    shown, excess = run.show(Forgery(messages=wild), torch.arange(2), "it")
    off = (shown - truth).abs()
    for column, most, half in ((X, x, 400), (VX, v, 50), (AX, a, 10)):
        assert (off[:, 2:, column] * half <= most + 1e-3).all()
    assert (off[:, :2] == 0).all()
    assert (off[:, 2 + senders :] == 0).all()
    assert (off[..., AGE] == 0).all()
    assert (off[..., 0] == 0).all()
    assert (shown.abs() <= 1).all()
    assert ((excess > 0) == ((wild[:, 2 : 2 + senders] - shown[:, 2 : 2 + senders]).abs() > 0).flatten(1).any(1)).all()
    assert (run.used.messages <= senders).all()


def test_more_senders_than_allowed_in_an_episode_are_refused_even_one_after_the_other() -> None:
    run, truth = forging(threat(senders=1, acceleration=2.0)), road()
    for row in (2, 2, 3):
        run.see(truth)
        lie = truth.clone()
        lie[:, row, AX] += 0.1
        if row == 3:
            with pytest.raises(UserError, match=r"2 senders in an episode, the threat model allows 1"):
                run.show(Forgery(messages=lie), torch.arange(2), "it")
            return
        run.show(Forgery(messages=lie), torch.arange(2), "it")
        run.close(truth, torch.arange(2))


@pytest.mark.parametrize(
    ("answer", "allowed", "why"),
    [
        (lambda o: Forgery(messages=o), ObservationThreat(), "allows none (threat.messages.senders)"),
        (lambda o: Forgery(dropped=o[..., 0] > 0), ObservationThreat(), "allows none (threat.messages.senders)"),
        (lambda o: Forgery(content=torch.full(o.shape[:2], 4)), threat(senders=1, delay=3), "allows 0 to 3"),
        (lambda o: Forgery(content=torch.full(o.shape[:2], -1)), threat(senders=1, delay=3), "allows 0 to 3"),
        (lambda o: Forgery(content=torch.zeros(2)), threat(senders=1, delay=3), "torch.int64"),
        (lambda o: Forgery(dropped=o[..., 0]), threat(senders=1, dropped=0.1), "not torch.bool"),
        (lambda o: Forgery(messages=o[:, :3]), threat(senders=1, speed=1.0), "answered messages of shape"),
        (lambda o: Forgery(messages=o * torch.inf), threat(senders=1, speed=1.0), "infinite"),
        (
            lambda o: Forgery(dropped=torch.arange(10).expand(2, 10) == 2),
            threat(senders=1, dropped=0.1),
            "in more frames than",
        ),
    ],
)
def test_what_the_set_does_not_allow_fails_in_one_line(answer: Any, allowed: ObservationThreat, why: str) -> None:
    with pytest.raises(UserError) as error:
        driven(Answers(answer=answer), allowed)
    assert why in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("messages", "why"),
    [
        ({"speed": 3.0}, "threat.messages.senders is 0|messages.senders is 0"),
        ({"senders": 2}, "senders alone allows nothing"),
        ({"senders": -1, "speed": 1.0}, "senders must be between"),
        ({"senders": 1, "dropped": 1.5}, "dropped must be"),
        ({"senders": 1, "keys": 2}, "messages.keys is unknown"),
    ],
)
def test_a_set_that_makes_no_sense_is_one_line(messages: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError, match=why) as error:
        threat(**messages)
    assert "\n" not in str(error.value)


def test_a_world_without_messages_refuses_the_set() -> None:
    from cavbench.envs.highway.world import HighwayWorld

    why = threat(senders=1, speed=1.0).lacks(HighwayWorld(), CACC())
    assert why.startswith("threat.messages is a set that the world does not carry out")


@pytest.mark.parametrize("delay", [1, 7])
def test_a_replay_of_n_decisions_is_the_message_of_then_seen_from_here(delay: int) -> None:
    columns, steps = driven(FalseData(mode="replay"), threat(senders=1, delay=delay))
    true, shown, x = steps["observation"], steps["perturbed"], steps["x"]
    # Absolute place, speed and command of the car ahead: what was true, `delay` decisions later. `x` is after the step.
    own = true[1:, :, 0, VX] * 50
    place = x[:-1] + true[1:, :, 2, X] * 400
    told = x[:-1] + shown[1:, :, 2, X] * 400
    assert told[delay:] == pytest.approx(place[:-delay], abs=5e-3)
    speed, said = own + true[1:, :, 2, VX] * 50, own + shown[1:, :, 2, VX] * 50
    assert said[delay:] == pytest.approx(speed[:-delay], abs=1e-4)
    assert torch.equal(shown[1 + delay :, :, 2, AX], true[1:-delay, :, 2, AX])
    # It looks fresh, and nobody else's messages changed.
    assert torch.equal(shown[..., AGE], true[..., AGE])
    assert torch.equal(shown[:, :, 3:], true[:, :, 3:])
    assert torch.equal(shown[:, :, :2], true[:, :, :2])
    assert (columns["false_messages"] > 0.9).all()


def test_messages_that_are_held_back_are_as_if_the_radio_lost_them() -> None:
    _, held = driven(FalseData(mode="drop"), threat(senders=3, dropped=1.0))
    shown, x = held["perturbed"], held["x"]
    # The first frame has nothing before it; so the sender is not known.
    assert (shown[0, :, 2:] == 0).all()

    first = 20
    only = torch.arange(10).expand(2, 10) == 2
    _, later = driven(Answers(answer=lambda o: Forgery(dropped=only), first=first), threat(senders=1, dropped=1.0))
    true, shown, x = later["observation"], later["perturbed"], later["x"]
    for after in range(10):
        step = first + after
        assert shown[step, 0, 2, AGE] == pytest.approx(-1 + 0.2 * (after + 1), abs=1e-5)
        # The place that was told last, in metres along the road.
        before = x[first - 2, 0] + true[first - 1, 0, 2, X] * 400
        assert x[step - 1, 0] + shown[step, 0, 2, X] * 400 == pytest.approx(float(before), abs=5e-3)
    assert (shown[first + 10, 0, 2] == 0).all()


def test_what_the_radio_loses_cannot_be_forged_and_the_last_lie_stays() -> None:
    _, steps = driven(FalseData(mode="offset"), threat(senders=1, acceleration=2.0), loss=0.5)
    true, shown = steps["observation"], steps["perturbed"]
    fresh = (true[..., 2, AGE] == -1) & (true[..., 2, 0] > 0)
    assert 0.3 < fresh.float().mean() < 0.7
    off = (shown[..., 2, AX] - true[..., 2, AX]) * 10
    assert off[fresh] == pytest.approx(2.0, abs=1e-4)
    # The command in a message that stays is the one that was told, not the true one.
    lost = (~fresh) & (true[..., 2, 0] > 0)
    lost[0] = False
    assert off[lost] == pytest.approx(2.0, abs=1e-4)
    assert shown[..., AGE] == pytest.approx(true[..., AGE], abs=1e-5)


def test_a_run_is_the_same_again_and_alone() -> None:
    allowed = threat(senders=2, position=10.0, speed=2.0, acceleration=2.0, delay=5)
    for mode in ("random", "frozen"):
        first, again = (driven(FalseData(mode=mode), allowed, loss=0.2, noise=1.0)[1] for _ in range(2))  # type: ignore[arg-type]
        assert all(torch.equal(first[name], again[name]) for name in ("perturbed", "executed", "x"))
    together = driven(FalseData(mode="ramp"), allowed, loss=0.2, noise=1.0)[1]["perturbed"]
    alone = driven(FalseData(mode="ramp"), allowed, loss=0.2, noise=1.0, seeds=(2,))[1]["perturbed"]
    assert torch.equal(together[:, 1:], alone)


def test_nothing_forged_is_nothing_changed() -> None:
    _, steps = driven(Answers(answer=lambda o: Forgery(messages=o.clone())), threat(senders=1, speed=5.0), loss=0.3)
    assert torch.equal(steps["observation"], steps["perturbed"])
    columns, steps = driven(
        Answers(answer=lambda o: Forgery(messages=o * torch.nan)), threat(senders=1, speed=5.0), loss=0.3
    )
    assert torch.equal(steps["observation"], steps["perturbed"])
    assert (columns["false_messages"] == 0).all()


def test_records_without_the_set_have_no_number() -> None:
    columns, _ = driven(None, ObservationThreat())
    assert torch.as_tensor(columns["false_messages"]).isnan().all()
