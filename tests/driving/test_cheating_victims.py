"""What a victim or a defence may not do: it drives as it answers, and what it does otherwise is flagged or refused."""

from __future__ import annotations

import random
import time
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.random import mtrand
from torch import Tensor

from cavbench.core.pair import Pair, choose
from cavbench.driving import Oracle, State
from cavbench.driving.draws import noise
from cavbench.driving.drive import _checked
from cavbench.errors import UserError
from cavbench.isolation.identifiers import opaque
from cavbench.isolation.watch import TamperError
from tests.driving.cheats import SEEDS, Noisy, Victim, drive, inconsistent

EPISODES = len(SEEDS)


class Decoy(Victim):
    """Answers otherwise when it thinks that an attack asks."""

    def suspects(self, observation: Tensor) -> bool:
        return False

    def forward(self, observation: Tensor) -> Tensor:
        scores = super().forward(observation)
        return -scores if self.suspects(observation) else scores


class WithGradients(Decoy):
    def suspects(self, observation: Tensor) -> bool:
        return torch.is_grad_enabled()


class OfLeaves(Decoy):
    def suspects(self, observation: Tensor) -> bool:
        return observation.requires_grad


class OfLargeBatches(Decoy):
    def suspects(self, observation: Tensor) -> bool:
        return len(observation) > EPISODES


class OfSmallBatches(Decoy):
    def suspects(self, observation: Tensor) -> bool:
        return len(observation) < EPISODES


class OfAllOtherBatches(Decoy):
    def suspects(self, observation: Tensor) -> bool:
        return len(observation) != EPISODES


class OfNumberedBatches(OfAllOtherBatches):
    """It draws noise, and looks whether it was given a number for it, or the generator of the process drew."""

    def forward(self, observation: Tensor) -> Tensor:
        return super().forward(observation) + 1e-9 * noise(observation).mean((-1, -2)).unsqueeze(-1)

    def suspects(self, observation: Tensor) -> bool:
        before = torch.get_rng_state()
        noise(observation)
        return super().suspects(observation) and torch.equal(torch.get_rng_state(), before)


class AfterSomeCalls(OfAllOtherBatches):
    calls = 0

    def suspects(self, observation: Tensor) -> bool:
        self.calls += 1
        return self.calls > 40 and super().suspects(observation)


class EverySecondCall(Decoy):
    calls = 0

    def suspects(self, observation: Tensor) -> bool:
        self.calls += 1
        return self.calls % 2 == 0


class AfterSomeTime(OfAllOtherBatches):
    def __init__(self) -> None:
        super().__init__()
        self.start = time.monotonic()

    def suspects(self, observation: Tensor) -> bool:
        return super().suspects(observation) and time.monotonic() > self.start + 0.005


class AlmostDeterministic(OfAllOtherBatches):
    """Hides behind noise that changes nothing."""

    def forward(self, observation: Tensor) -> Tensor:
        return super().forward(observation) + 1e-9 * torch.randn(1)


class Chooses(Victim):
    """Shows scores that it does not act on."""

    def choose(self, scores: Tensor) -> Tensor:
        return scores.argmin(-1)


DECOYS = [
    WithGradients,
    OfLeaves,
    OfLargeBatches,
    OfSmallBatches,
    OfAllOtherBatches,
    OfNumberedBatches,
    AfterSomeCalls,
    AfterSomeTime,
    AlmostDeterministic,
    Chooses,
]


def of_torch() -> object:
    return bytes(torch.get_rng_state().numpy())


def of_numpy() -> object:
    return repr(np.random.get_state(legacy=False)["state"])  # noqa: NPY002


def which_numpy() -> object:
    return id(mtrand.get_bit_generator())


LOOKS = [torch.initial_seed, of_torch, random.getstate, of_numpy, which_numpy]


class ByGenerators(Decoy):
    """Lies to questions, if the random generators look the same, or if they look otherwise, than at its last answer."""

    def __init__(self, look: Callable[[], object], same: bool, draws: bool) -> None:
        super().__init__()
        self.look, self.same, self.draws = look, same, draws
        self.seen: object = None
        self.lies = 0

    def suspects(self, observation: Tensor) -> bool:
        lies = len(observation) != EPISODES and (self.look() == self.seen) == self.same
        self.lies += lies
        if self.draws:
            torch.rand(1), np.random.random(), random.random()  # noqa: NPY002
        if not self.draws or len(observation) == EPISODES:
            self.seen = self.look()
        return lies


@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("same", [True, False])
@pytest.mark.parametrize("draws", [True, False])
def test_a_decoy_that_looks_at_random_generators_is_flagged(
    look: Callable[[], object], same: bool, draws: bool
) -> None:
    def ask(observation: Tensor, oracle: Oracle) -> None:
        for _ in range(2):
            oracle.scores(observation.expand(3, *observation.shape))

    victim = ByGenerators(look, same, draws)
    flagged = [np.nanmean(drive(ask, victim, entropy=entropy, queries=1000)["inconsistent"]) for entropy in (0, 1)]
    # One that draws sees the same seed, or the same generator, in all questions: it has nobody to lie to, or lies to all.
    assert victim.lies == 0 or np.mean(flagged) >= 0.05


class AfterSomeQuestions(OfAllOtherBatches):
    """Lies from the fifth question in a row on."""

    row = 0

    def suspects(self, observation: Tensor) -> bool:
        self.row = self.row + 1 if super().suspects(observation) else 0
        return self.row > 4


def test_a_decoy_that_counts_the_questions_of_a_step_is_flagged() -> None:
    def ask(observation: Tensor, oracle: Oracle) -> None:
        for _ in range(12):
            oracle.scores(observation.expand(3, *observation.shape))

    victim = AfterSomeQuestions()
    flagged = [np.nanmean(drive(ask, victim, entropy=entropy, queries=5000)["inconsistent"]) for entropy in (0, 1)]
    assert np.mean(flagged) >= 0.05


@pytest.mark.parametrize("cheat", DECOYS)
def test_a_decoy_is_flagged(cheat: type[Victim]) -> None:
    assert inconsistent(cheat()) >= 0.05


def test_a_decoy_of_every_second_call_looks_random() -> None:
    assert np.nanmean(drive(policy=EverySecondCall())["redrawn"]) > 0.5


class Sometimes(Victim):
    """A defence that drops half of what it sees in every fifth decision of an episode."""

    def forward(self, observation: Tensor) -> Tensor:
        dropped = torch.rand(observation.shape[:-2]) < 0.2
        return super().forward(torch.where(dropped[..., None, None], observation * 0.5, observation))


@pytest.mark.parametrize("honest", [Victim, Noisy, Sometimes])
def test_an_honest_victim_is_not_flagged_random_or_not(honest: type[Victim]) -> None:
    assert inconsistent(honest()) < 0.01


def test_it_drives_by_its_scores_whatever_it_would_decide() -> None:
    class Two(Victim):
        def decide(self, observation: Tensor, state: State = None) -> Tensor:
            return self.choose(-self.scores(observation, state))

    assert np.array_equal(drive(policy=Two())["action_counts"], drive(policy=Victim())["action_counts"])


def test_the_probed_steps_follow_from_a_seed_that_is_recorded() -> None:
    first, again, other = (drive(policy=Noisy(), entropy=entropy) for entropy in (1, 1, 2))
    assert set(first["entropy"].tolist()) == {1}
    for name in ("redrawn", "same_answer", "inconsistent"):
        np.testing.assert_array_equal(first[name], again[name])
    assert np.array_equal(first["action_counts"], other["action_counts"])


def test_what_a_victim_does_that_is_random_now_and_then_does_not_follow_from_the_probes() -> None:
    def drawing() -> Victim:
        start: list[Tensor] = []

        class NotAtFirst(Victim):
            def forward(self, observation: Tensor) -> Tensor:
                start.extend([] if start else [observation.clone()])
                if torch.equal(observation, start[0]):
                    return super().forward(observation)
                shift = torch.zeros_like(observation)
                shift[..., 1:] = 0.3 * noise(observation)
                return super().forward(observation + shift)

        return NotAtFirst()

    first, other = (drive(policy=drawing(), entropy=entropy) for entropy in (1, 2))
    for name in ("return", "action_counts"):
        np.testing.assert_array_equal(first[name], other[name])


def test_a_policy_is_told_no_scenario_seed() -> None:
    told: list[Tensor] = []

    class Curious(Victim):
        def initial(self, episodes: Tensor) -> State:
            told.append(episodes)
            return None

    drive(policy=Curious())
    drive(policy=Curious())
    (first, again) = (one.tolist() for one in told)
    assert first == again
    assert len({*first, *SEEDS}) == 2 * len(SEEDS)
    assert opaque(SEEDS, 7).tolist() != opaque(SEEDS, 8).tolist()


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_victim_that_answers_no_number_is_refused(value: float) -> None:
    class Broken(Victim):
        def forward(self, observation: Tensor) -> Tensor:
            return super().forward(observation) * value

    with pytest.raises(UserError, match=r"the victim \(Broken\) answered NaN or infinite scores while driving"):
        drive(policy=Broken())


def test_a_victim_that_answers_complex_numbers_is_refused() -> None:
    class Broken(Victim):
        def forward(self, observation: Tensor) -> Tensor:
            return super().forward(observation) + 0j

    with pytest.raises(UserError, match=r"the victim \(Broken\) answered complex scores"):
        drive(policy=Broken())


def test_a_victim_that_answers_no_number_to_queries_alone_is_refused() -> None:
    class Broken(Victim):
        def forward(self, observation: Tensor) -> Tensor:
            return super().forward(observation) * (torch.nan if len(observation) != EPISODES else 1)

    with pytest.raises(UserError, match="answered NaN or infinite scores to a query"):
        drive(policy=Broken())


def test_a_victim_that_writes_to_its_input_changes_no_query_of_the_attack() -> None:
    class Scribbles(Victim):
        def forward(self, observation: Tensor) -> Tensor:
            scores = super().forward(observation)
            with torch.no_grad():
                observation.detach().zero_()
            return scores

    changed: list[bool] = []

    def ask(observation: Tensor, oracle: Oracle) -> None:
        points = observation.expand(4, *observation.shape).clone()
        before = points.clone()
        oracle.scores(points)
        oracle.gradient(points, lambda scores: scores.sum(-1))
        changed.append(not torch.equal(points, before))

    drive(ask, Scribbles())
    assert not any(changed)


def test_a_victim_that_changes_its_weights_is_refused_and_named() -> None:
    class Learns(Victim):
        def forward(self, observation: Tensor) -> Tensor:
            self.weights.mul_(0.999)
            return super().forward(observation)

    with pytest.raises(TamperError, match="weights") as refused:
        drive(policy=Learns())
    assert "defense" in refused.value.sides
    with pytest.raises(TamperError, match="weights") as refused:
        drive(lambda observation, oracle: oracle.scores(observation) and None, Learns())


def test_scores_that_answer_for_themselves_are_refused() -> None:
    class Own(Tensor):
        pass

    class Sly(Victim):
        def forward(self, observation: Tensor) -> Tensor:
            return super().forward(observation).as_subclass(Own)

    with pytest.raises(TamperError, match="the victim's scores are a Own"):
        drive(policy=Sly())


def test_a_policy_that_leaves_the_wheel_to_the_world_is_refused() -> None:
    pair = Pair(
        attack=choose("attack", "none"),
        defense=choose("defense", "none"),
        victim=choose("victim", "dqn"),
        world=choose("world", "highway"),
        threat=choose("victim", "dqn").component.threat.of_nobody(),
    )
    policy = Victim()
    assert _checked(policy, pair) is policy
    policy.driver = "idm"
    with pytest.raises(UserError, match="has driver 'idm', its victim declares 'agent'"):
        _checked(policy, pair)
