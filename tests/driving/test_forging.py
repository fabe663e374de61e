"""The run enforces the sets of a threat model: what is counted is refused, what is continuous is clipped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.driving import DrivingAttack, Forgery, ObservationThreat, Oracle, State, composed
from cavbench.driving.attacker import Attacker, Shown
from cavbench.driving.invented import ACCELERATION, TOLERANCE
from cavbench.driving.victim import CountedPolicy
from cavbench.errors import UserError
from tests.attacks.driving.victims import FEATURES, observations, victim

BATCH, STEPS = 3, 20


@dataclass(frozen=True, kw_only=True)
class Liar(DrivingAttack):
    """Answers whatever a test tells it."""

    access: ClassVar[Access] = "oblivious"
    answer: Callable[[Tensor, Oracle], Any] = lambda observation, oracle: observation

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Any, State]:
        return self.answer(observation, oracle), state


def at_work(answer: Callable[[Tensor, Oracle], Any], kind: str = "discrete", **allowed: Any) -> Attacker:
    threat = ObservationThreat(**allowed)
    return Attacker(Liar(answer=answer), CountedPolicy(victim(kind)), threat, FEATURES, seed=0, steps=STEPS)  # type: ignore[arg-type]


def truth(step: int = 0) -> Tensor:
    """Every row holds a car, nearest first."""
    found = observations(BATCH, step)
    found[..., 0] = 1.0
    found[:, 0, 1:] = torch.tensor([0.0, 0.2, 0.5, 0.0])
    x = 1 + FEATURES.names.index("x")
    order = found[:, 1:, x].abs().argsort(1)[..., None].expand(-1, -1, found.shape[2])
    return torch.cat((found[:, :1], found[:, 1:].gather(1, order)), 1)


def show(attacker: Attacker, step: int = 0) -> Shown:
    return attacker.show(truth(step), torch.ones(BATCH, dtype=torch.bool), None)


def drive(attacker: Attacker, shown: list[Tensor] | None = None) -> None:
    """A whole episode; what was shown in each step is added to `shown`."""
    for step in range(STEPS):
        found = show(attacker, step).observation
        if shown is not None:
            shown.append(found)


def rows(count: int, cars: Tensor) -> Tensor:
    """Hides the first `count` other cars."""
    hidden = torch.zeros(cars.shape[:2], dtype=torch.bool)
    hidden[:, 1 : 1 + count] = True
    return hidden


def ghosts(count: int, cars: Tensor, x: float = 0.2) -> Tensor:
    made = torch.zeros(len(cars), count, cars.shape[2])
    made[..., 0], made[..., 1 + FEATURES.names.index("x")] = 1.0, x
    return made


def ages(age: int) -> Tensor:
    return torch.full((BATCH,), age)


FORGED: list[tuple[str, Callable[[Tensor, Oracle], Any], dict[str, Any], str]] = [
    ("nothing allowed", lambda o, _: Forgery(hidden=rows(1, o)), {}, "hid 1 cars at once, the threat model allows 0"),
    ("too many hidden", lambda o, _: Forgery(hidden=rows(2, o)), {"presence": {"hidden": 1}}, "hid 2 cars at once"),
    ("the ego", lambda o, _: Forgery(hidden=~rows(9, o)), {"presence": {"hidden": 9}}, "hid the ego"),
    ("no bools", lambda o, _: Forgery(hidden=rows(1, o).float()), {"presence": {"hidden": 1}}, "not as torch.bool"),
    ("ghosts", lambda o, _: Forgery(invented=ghosts(2, o)), {"presence": {"invented": 1}}, "invented 2 cars at once"),
    (
        "no number",
        lambda o, _: Forgery(invented=ghosts(1, o, float("nan"))),
        {"presence": {"invented": 1}},
        "NaN or infinite",
    ),
    (
        "a late frame",
        lambda o, _: Forgery(age=ages(1)),
        {},
        "a frame that is 1 decisions old, the threat model allows 0",
    ),
    ("the future", lambda o, _: Forgery(age=ages(-1)), {"latency": {"frames": 3}}, "a frame of the future"),
    ("a share", lambda o, _: Forgery(hidden=rows(1, o)), {"presence": {"hidden": 1, "share": 0.1}}, "in more frames"),
    ("another command", lambda o, _: Forgery(action=ages(4)), {}, "the threat model allows none"),
    ("a late command", lambda o, _: Forgery(delay=ages(2)), {"actuator": {"delay": 1}}, "delayed a command by 2"),
    ("another shape", lambda o, _: Forgery(hidden=rows(1, o)[:1]), {"presence": {"hidden": 1}}, "of shape"),
    ("a mapping", lambda o, _: {"hidden": rows(1, o)}, {"presence": {"hidden": 1}}, "not a torch.Tensor"),
]


@pytest.mark.parametrize(("answer", "allowed", "why"), [case[1:] for case in FORGED], ids=[case[0] for case in FORGED])
def test_a_plug_in_that_forges_beyond_its_set_is_refused(
    answer: Callable[[Tensor, Oracle], Any], allowed: dict[str, Any], why: str
) -> None:
    attacker = at_work(answer, **allowed)
    with pytest.raises(UserError, match=why) as refused:
        drive(attacker)
    assert len(str(refused.value).splitlines()) == 1


def test_presence_in_the_values_is_projected_away() -> None:
    def forged(observation: Tensor, oracle: Oracle) -> Tensor:
        return torch.cat((torch.zeros_like(observation[..., :1]), observation[..., 1:]), -1)

    assert bool((show(at_work(forged, presence={"hidden": 3})).observation[..., 0] == 1).all())


def test_the_oracle_gives_copies_of_the_past() -> None:
    def vandal(observation: Tensor, oracle: Oracle) -> Forgery:
        oracle.past(0).zero_()
        oracle.left("presence").fill_(100)
        return Forgery(age=torch.zeros(BATCH, dtype=torch.int64))

    attacker = at_work(vandal, latency={"frames": 2})
    torch.testing.assert_close(show(attacker).observation, truth(), rtol=0, atol=0)


def test_a_hidden_car_is_gone_and_the_others_move_up() -> None:
    shown = show(at_work(lambda o, _: Forgery(hidden=rows(1, o)), presence={"hidden": 1}))
    torch.testing.assert_close(shown.observation[:, 1:-1], truth()[:, 2:], rtol=0, atol=0)
    assert not shown.observation[:, -1].any()
    assert shown.used is not None
    assert shown.used.hidden.tolist() == [1] * BATCH


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 99), st.integers(1, 3), st.floats(-1, 1))
def test_composed_lists_the_nearest_first_and_keeps_the_order_of_real_cars(seed: int, count: int, x: float) -> None:
    cars = truth(seed)
    found = composed(cars, FEATURES, rows(seed % 3, cars), ghosts(count, cars, x))
    distance = (
        FEATURES.physical(found)[:, 1:, FEATURES.names.index("x")].abs().masked_fill(found[:, 1:, 0] <= 0, torch.inf)
    )
    assert bool((distance.diff(dim=1).nan_to_num(0) >= -1e-4).all())
    torch.testing.assert_close(found[:, 0], cars[:, 0], rtol=0, atol=0)


def test_a_late_sensor_shows_what_was_measured_before() -> None:
    attacker = at_work(lambda o, _: Forgery(age=ages(2)), latency={"frames": 2})
    shown: list[Tensor] = []
    drive(attacker, shown)
    assert all(torch.equal(one, truth(max(step - 2, 0))) for step, one in enumerate(shown))


def test_time_never_runs_backwards() -> None:
    order = iter((0, 0, 0, 2))
    attacker = at_work(lambda o, _: Forgery(age=ages(next(order))), latency={"frames": 2})
    with pytest.raises(UserError, match="an earlier frame after a later one"):
        drive(attacker)


@pytest.mark.parametrize("allowed", [{"latency": {"frames": 3}}, {"held": {"longest": 9, "share": 1.0}}])
def test_an_answer_of_values_alone_shows_the_newest_frame(allowed: dict[str, Any]) -> None:
    """After it no older frame may be shown, as after an answer that says so."""
    order = iter((0, 1, 2, None, 1, None, 2))
    shown: list[Tensor] = []

    def answer(observation: Tensor, oracle: Oracle) -> Any:
        age = next(order)
        return observation if age is None else Forgery(age=ages(age))

    with pytest.raises(UserError, match="an earlier frame after a later one"):
        drive(at_work(answer, **allowed), shown)
    assert len(shown) == 6
    assert all(torch.equal(one, truth(step)) for step, one in zip((0, 0, 0, 3, 3, 5), shown, strict=True))


def test_an_invented_car_has_gone_after_an_answer_of_values_alone() -> None:
    """It may appear elsewhere then: it need not go on from where it was."""
    order = iter((0.2, None, 0.6))

    def answer(observation: Tensor, oracle: Oracle) -> Any:
        x = next(order)
        return observation if x is None else Forgery(invented=ghosts(1, observation, x))

    attacker = at_work(answer, presence={"invented": 1})
    excess = [show(attacker, step).excess for step in range(3)]
    assert all(float(one.max()) < 0.01 for one in excess)


@pytest.mark.parametrize(("longest", "share", "why"), [(2, 1.0, "repetitions in a row"), (15, 0.1, "held the sensor")])
def test_a_frozen_sensor_thaws(longest: int, share: float, why: str) -> None:
    count = iter(range(STEPS))
    attacker = at_work(lambda o, _: Forgery(age=ages(next(count))), held={"longest": longest, "share": share})
    shown: list[Tensor] = []
    with pytest.raises(UserError, match=why):
        drive(attacker, shown)
    assert len(shown) == 3
    assert all(torch.equal(one, truth(0)) for one in shown)


def test_an_invented_car_that_jumps_is_brought_back_to_what_cars_can_do() -> None:
    places = iter((0.2, -0.9))
    attacker = at_work(lambda o, _: Forgery(invented=ghosts(1, o, next(places))), presence={"invented": 1})
    still = truth()
    first = attacker.show(still, torch.ones(BATCH, dtype=torch.bool), None)
    assert float(first.excess.max()) < 1e-5
    second = attacker.show(still, torch.ones(BATCH, dtype=torch.bool), None)
    assert attacker.enforcer.forging is not None
    ghost = attacker.enforcer.forging.ghosts
    assert ghost is not None
    place = FEATURES.physical(ghost)[:, 0, FEATURES.names.index("x")]
    allowed = ACCELERATION / 15**2 + TOLERANCE
    start = FEATURES.physical(ghosts(1, still, 0.2))[:, 0, FEATURES.names.index("x")]
    # At rest beside the ego it moves by less than a car can accelerate.
    assert bool(((place - start).abs() <= allowed + 1e-3).all())
    assert float(second.excess.min()) > 0.1


def test_commands_are_executed_late() -> None:
    attacker = at_work(lambda o, _: Forgery(delay=ages(2)), actuator={"delay": 2})
    executed = []
    for step in range(5):
        show(attacker, step)
        executed.append(int(attacker.execute(torch.full((BATCH,), step))[0]))
    assert executed == [0, 0, 0, 1, 2]


def test_the_coin_of_a_frame_is_the_same_whether_or_not_the_attack_answered_before() -> None:
    def replaced(answers: Callable[[int], bool]) -> list[bool]:
        steps = iter(range(60))
        attacker = at_work(
            lambda o, _: Forgery(action=ages(4)) if answers(next(steps)) else Forgery(), actuator={"replaced": 0.3}
        )
        found = []
        for step in range(60):
            show(attacker, step % 7)
            found.append(bool((attacker.execute(torch.zeros(BATCH, dtype=torch.int64)) == 4)[0]))
        return found

    always, late = replaced(lambda step: True), replaced(lambda step: step >= 20)
    assert 5 < sum(always) < 30
    assert late == [False] * 20 + always[20:]


def test_the_run_tosses_the_coin_of_the_probabilistic_action_robust_process() -> None:
    attacker = at_work(lambda o, _: Forgery(action=ages(4)), actuator={"replaced": 0.3})
    replaced = []
    for step in range(400):
        show(attacker, step % 7)
        replaced.append(attacker.execute(torch.zeros(BATCH, dtype=torch.int64)) == 4)
    share = float(torch.stack(replaced).float().mean())
    assert 0.25 < share < 0.35


def test_the_noisy_action_robust_process_mixes_and_the_shift_is_clipped() -> None:
    full = torch.ones(BATCH, 2)
    attacker = at_work(lambda o, _: Forgery(action=full), "continuous", actuator={"noise": 0.25})
    show(attacker)
    torch.testing.assert_close(attacker.execute(-full), -full + 0.5)
    attacker = at_work(lambda o, _: Forgery(shift=5 * full), "continuous", actuator={"offset": 0.1})
    show(attacker)
    torch.testing.assert_close(attacker.execute(0 * full), 0.1 * full)


def test_an_action_that_the_world_does_not_have_is_refused() -> None:
    attacker = at_work(lambda o, _: Forgery(action=ages(9)), actuator={"replaced": 1.0})
    show(attacker)
    with pytest.raises(UserError, match="no whole number from 0 to 4"):
        attacker.execute(torch.zeros(BATCH, dtype=torch.int64))
