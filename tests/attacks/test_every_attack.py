"""Every built-in attack keeps the rules of `bench check`; attacks without a network keep them with any parameters."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from cavbench.attacks.driving.bias import Bias
from cavbench.attacks.driving.noise import Noise
from cavbench.attacks.driving.pgd import PGD
from cavbench.attacks.driving.zo import ZOSignSGD
from cavbench.core import registry
from cavbench.driving import ActionType, DrivingAttack, ObservationThreat
from cavbench.driving.threat import Norm
from tests.attacks.driving.victims import FEATURES, observations, perturb, victim
from tests.checks.rules import broken, built_in, each
from tests.cli.test_cli import assert_one_line
from tests.command import Bench

OWN_TESTS = {"art", "given_patch", "none"}
"""`art` needs a choice: test_art.py checks some. `given_patch` needs a picture: test_given_patch.py has one. `none` answers
nothing: test_none.py drives with it."""
ATTACKS = built_in("attack").keys() - OWN_TESTS

OBJECTIVES = ("collision", "expected", "margin", "target")
ZO_OBJECTIVES = (*OBJECTIVES, "thesis")

zo = st.builds(
    ZOSignSGD,
    steps=st.integers(1, 4),
    directions=st.integers(1, 9),
    smoothing=st.floats(0.1, 2),
    step_size=st.floats(0.1, 2),
    objective=st.sampled_from(ZO_OBJECTIVES),
    early_stop=st.booleans(),
    random_start=st.booleans(),
)
pgd = st.builds(
    PGD,
    steps=st.integers(1, 4),
    step_size=st.floats(0.1, 2),
    restarts=st.integers(1, 3),
    random_start=st.booleans(),
    momentum=st.floats(0, 0.9),
    objective=st.sampled_from(OBJECTIVES),
)
noise = st.builds(Noise, distribution=st.sampled_from(("uniform", "gaussian")), scale=st.floats(0.1, 1))
attacks = st.one_of(zo, pgd, noise)
action_types: st.SearchStrategy[ActionType] = st.sampled_from(("discrete", "continuous"))
norms: st.SearchStrategy[Norm] = st.sampled_from(("relative", "linf"))


@each(sorted(ATTACKS))
def test_it_keeps_the_rules(name: str) -> None:
    assert broken("attack", name) == {}


@each(sorted(name for name in ATTACKS if getattr(registry.load("attack", name), "drives", False)))
def test_an_attack_that_drives_cars_is_refused_before_anything_is_driven(name: str, bench: Bench) -> None:
    said = bench("run", f"attack={name}", "victim=dqn", "lanes=3", "seeds=0")
    assert_one_line(said, f"attack '{name}' can do nothing under this threat model: allow it threat.traffic.cars=1")


@settings(max_examples=80, deadline=None)
@given(attacks, action_types, norms, st.floats(0, 0.5), st.integers(0, 99))
def test_the_answer_is_within_the_perturbation_set(
    attack: DrivingAttack, action_type: ActionType, norm: Norm, budget: float, seed: int
) -> None:
    threat, observation = ObservationThreat(norm=norm, budget=budget), observations(6, seed)
    shown, _ = perturb(attack, victim(action_type, seed), observation, threat, seed)
    radius = threat.radius(observation, FEATURES)
    assert shown.dtype == observation.dtype
    assert not shown.requires_grad
    assert bool(((shown - observation).abs() <= radius + 1e-6).all())
    assert bool((shown.abs() <= 1).all())
    assert torch.equal(shown[..., 0], observation[..., 0])
    absent = observation[..., 0] == 0
    assert torch.equal(shown[absent], observation[absent])


@settings(max_examples=80, deadline=None)
@given(attacks, action_types, st.integers(0, 60), st.integers(0, 99))
def test_no_attack_exceeds_its_query_budget(
    attack: DrivingAttack, action_type: ActionType, queries: int, seed: int
) -> None:
    threat = ObservationThreat(budget=0.2, queries=queries)
    _, spent = perturb(attack, victim(action_type, seed), observations(6, seed), threat, seed)
    assert int(spent.max()) <= queries


@settings(max_examples=40, deadline=None)
@given(attacks, action_types, st.integers(0, 99))
def test_the_same_seed_gives_the_same_answer(attack: DrivingAttack, action_type: ActionType, seed: int) -> None:
    policy, observation = victim(action_type), observations(6, seed)
    first, asked = perturb(attack, policy, observation, seed=seed)
    second, again = perturb(attack, policy, observation, seed=seed)
    assert torch.equal(first, second)
    assert torch.equal(asked, again)


@settings(max_examples=40, deadline=None)
@given(st.one_of(zo, pgd), action_types, st.integers(0, 99))
def test_an_episode_is_attacked_the_same_alone_or_in_a_batch(
    attack: DrivingAttack, action_type: ActionType, seed: int
) -> None:
    # At the clean action these have a kink or no slope: there rounding decides what the gradient is.
    kinked = isinstance(attack, PGD) and attack.objective in ("collision", "margin") and not attack.random_start
    assume(not (kinked and action_type == "continuous"))
    # In double precision, so that the order of a sum does not decide a sign.
    policy, observation = victim(action_type).double(), observations(5, seed).double()
    together, asked = perturb(attack, policy, observation, seed=seed)
    alone = [perturb(attack, policy, observation[b : b + 1], seed=seed) for b in range(5)]
    assert torch.equal(asked, torch.cat([spent for _, spent in alone]))
    torch.testing.assert_close(together, torch.cat([shown for shown, _ in alone]))


@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
@pytest.mark.parametrize("attack", [ZOSignSGD(), PGD(), Noise(), Bias()], ids=lambda a: type(a).__name__)
def test_the_victim_and_the_observation_do_not_change(attack: DrivingAttack, action_type: ActionType) -> None:
    policy, observation = victim(action_type), observations(6)
    weights, truth = deepcopy(policy.state_dict()), observation.clone()
    perturb(attack, policy, observation)
    assert torch.equal(observation, truth)
    assert all(torch.equal(weights[name], value) for name, value in policy.state_dict().items())
    assert all(weight.grad is None for weight in policy.parameters())


@pytest.mark.parametrize("attack", [ZOSignSGD(), PGD(), Noise(), Bias()], ids=lambda a: type(a).__name__)
def test_an_empty_batch_is_returned(attack: DrivingAttack) -> None:
    shown, spent = perturb(attack, victim("discrete"), observations(0))
    assert shown.shape == (0, 4, 5)
    assert spent.shape == (0,)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (ZOSignSGD, {"steps": 0}),
        (ZOSignSGD, {"directions": 0}),
        (ZOSignSGD, {"smoothing": 0.0}),
        (ZOSignSGD, {"step_size": 2.1}),
        (ZOSignSGD, {"step_size": float("nan")}),
        (ZOSignSGD, {"objective": "crash"}),
        (ZOSignSGD, {"temperature": 0.0}),
        (ZOSignSGD, {"target_action": -1}),
        (ZOSignSGD, {"target_steering": 1.5}),
        (ZOSignSGD, {"tolerance": -0.1}),
        (ZOSignSGD, {"distortion_weight": -1.0}),
        (ZOSignSGD, {"enough": 0.0}),
        (PGD, {"steps": 0}),
        (PGD, {"restarts": 0}),
        (PGD, {"step_size": 0.0}),
        (PGD, {"momentum": 1.0}),
        (PGD, {"objective": "thesis"}),
        (PGD, {"temperature": float("nan")}),
        (PGD, {"braking_action": -1}),
        (PGD, {"target_acceleration": -2.0}),
        (Noise, {"scale": 0.0}),
        (Noise, {"distribution": "laplace"}),
    ],
)
def test_a_bad_parameter_is_named_in_one_line(kind: type[DrivingAttack], words: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(words))) as error:
        kind(**words)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("attack", [PGD(objective="target", target_action=9), ZOSignSGD(braking_action=9)])
def test_an_action_the_victim_does_not_have_is_refused(attack: DrivingAttack) -> None:
    with pytest.raises(ValueError, match="5 actions, got 9"):
        perturb(attack, victim("discrete"), observations(2))
