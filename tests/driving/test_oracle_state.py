"""The oracle returns the policy's own answers for its state, and queries change nothing."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDictBase
from torch import Tensor

from cavbench.driving import ObservationThreat, Oracle, Policy
from cavbench.driving.access import Enforcer
from cavbench.driving.victim import CHUNK, CountedPolicy
from cavbench.errors import UserError
from tests.attacks.driving.victims import FEATURES, observations, victim
from tests.driving.policies import STATEFUL, remembered, stacked

BATCH = 6
LEADING = st.lists(st.integers(0, 3), max_size=2).map(tuple)
ROWS = st.none() | st.lists(st.integers(0, BATCH - 1), unique=True)
STEPS = st.integers(0, 5)
assert_same = partial(torch.testing.assert_close, rtol=1e-5, atol=1e-5)
"""For one query beside a batch of them: a product of matrices rounds by its size."""

every_policy = pytest.mark.parametrize("name", STATEFUL)
at_any_size = settings(max_examples=15, deadline=None)


def opened(policy: Policy, state: TensorDictBase) -> Oracle:
    """An oracle that allows everything, in a step of the state's episodes."""
    return started(policy, state)[1]


def started(policy: Policy, state: TensorDictBase) -> tuple[Enforcer, Oracle]:
    """The same, and the run's side of it."""
    generator = torch.Generator().manual_seed(0)
    enforcer = Enforcer(CountedPolicy(policy), ObservationThreat(queries=10**6), "gradients", FEATURES, generator)
    return enforcer, enforcer.begin(observations(len(state), 99), state)


def chosen(oracle: Oracle, rows: list[int] | None) -> Oracle:
    """The oracle of these episodes; the whole one for None."""
    return oracle if rows is None else oracle.select(torch.tensor(rows, dtype=torch.int64))


def asked_about(leading: Sequence[int], episodes: int) -> Tensor:
    """Queries [*leading, episodes, V, F]."""
    count = int(torch.tensor([*leading, episodes]).prod())
    return observations(count, 7).reshape(*leading, episodes, 4, 5)


def one_by_one(state: TensorDictBase, rows: list[int] | None, question: Tensor) -> list[tuple[Tensor, TensorDictBase]]:
    """Every query [1, V, F] with what is remembered of its episode, batch size [1]."""
    places = list(range(len(state))) if rows is None else rows
    flat = question.flatten(0, -3)
    return [(flat[i : i + 1], state[places[i % len(places)] : places[i % len(places)] + 1]) for i in range(len(flat))]


def weighed(scores: Tensor) -> Tensor:
    """A loss [...] of scores that hangs on all of them."""
    return (scores.tanh() * torch.arange(1, scores.shape[-1] + 1)).sum(-1)


@every_policy
@at_any_size
@given(leading=LEADING, rows=ROWS, steps=STEPS)
def test_answers_equal_the_policys_with_the_same_state(
    name: str, leading: tuple[int, ...], rows: list[int] | None, steps: int
) -> None:
    policy = STATEFUL[name]()
    state = remembered(policy, BATCH, steps)
    before, oracle = state.clone(), chosen(opened(policy, state), rows)
    question = asked_about(leading, BATCH if rows is None else len(rows))
    scores, decisions = oracle.scores(question), oracle.decide(question)
    assert scores.shape[:-1] == question.shape[:-2]
    flat = scores.flatten(0, -2)
    for index, (query, own) in enumerate(one_by_one(state, rows, question)):
        assert_same(flat[index], policy.scores(query, own)[0])
    assert_same(decisions, policy.choose(scores), rtol=0, atol=0)
    assert bool((state == before).all())
    assert_same(oracle.scores(question), scores, rtol=0, atol=0)


@every_policy
@at_any_size
@given(leading=LEADING, rows=ROWS, steps=STEPS)
def test_gradients_equal_the_policys_with_the_same_state(
    name: str, leading: tuple[int, ...], rows: list[int] | None, steps: int
) -> None:
    policy = STATEFUL[name]()
    state = remembered(policy, BATCH, steps)
    before, oracle = state.clone(), chosen(opened(policy, state), rows)
    question = asked_about(leading, BATCH if rows is None else len(rows))
    value, gradient = oracle.gradient(question, weighed)
    assert (value.shape, gradient.shape) == (question.shape[:-2], question.shape)
    values, gradients = value.flatten(), gradient.flatten(0, -3)
    for index, (query, own) in enumerate(one_by_one(state, rows, question)):
        leaf = query.clone().requires_grad_()
        alone = weighed(policy.scores(leaf, own))
        assert_same(values[index], alone.detach()[0])
        if alone.requires_grad:
            assert_same(gradients[index], torch.autograd.grad(alone.sum(), leaf)[0][0])
        else:
            assert not gradients[index].any()
    assert bool((state == before).all())
    assert not any(value.requires_grad for value in state.values(include_nested=True, leaves_only=True))


@at_any_size
@given(leading=LEADING, steps=STEPS)
def test_the_critic_answers_from_the_same_state(leading: tuple[int, ...], steps: int) -> None:
    policy = STATEFUL["stacked ddpg"]()
    state = remembered(policy, BATCH, steps)
    before, oracle = state.clone(), opened(policy, state)
    question = asked_about(leading, BATCH)
    action = (question[..., 0, 1:3].clone()).requires_grad_()
    value = oracle.value(question, action)
    assert value.shape == question.shape[:-2]
    (gradient,) = torch.autograd.grad(value.sum(), action)
    values, actions, gradients = value.detach().flatten(), action.detach().flatten(0, -2), gradient.flatten(0, -2)
    for index, (query, own) in enumerate(one_by_one(state, None, question)):
        leaf = actions[index : index + 1].clone().requires_grad_()
        alone = policy.value(query, leaf, own)
        assert_same(values[index], alone.detach()[0])
        assert_same(gradients[index], torch.autograd.grad(alone.sum(), leaf)[0][0])
    assert bool((state == before).all())
    assert oracle.spent.tolist() == [question.shape[:-3].numel()] * BATCH


@every_policy
def test_more_queries_than_a_chunk_are_answered_from_the_right_episodes(name: str) -> None:
    policy = STATEFUL[name]()
    state = remembered(policy, 7, 4)
    leading = (2, CHUNK // 7)
    question = asked_about(leading, 7)
    scores = opened(policy, state).scores(question)
    assert question.shape[:-2].numel() > CHUNK
    for index in ((0, 0), (0, CHUNK // 7 - 1), (1, 3), (1, CHUNK // 7 - 1)):
        assert_same(scores[index], policy.scores(question[index], state))


def test_the_answer_depends_on_the_state() -> None:
    """Else the tests above would hold for an oracle that forgets."""
    policy = stacked(victim("discrete"))
    here, elsewhere = (remembered(policy, BATCH, 4, seed) for seed in (0, 1))
    question = asked_about((), BATCH)
    first, other = (opened(policy, state).scores(question) for state in (here, elsewhere))
    assert (first != other).any(-1).all()
    swapped = chosen(opened(policy, here), [1, 0]).scores(question[[1, 0]])
    assert_same(swapped, first[[1, 0]])


def test_queries_are_counted_for_their_episodes() -> None:
    policy = stacked(victim("discrete"))
    enforcer, oracle = started(policy, remembered(policy, BATCH, 4))
    some = chosen(oracle, [4, 1])
    some.scores(asked_about((3,), 2))
    chosen(some, [0]).gradient(asked_about((2, 2), 1), weighed)
    assert oracle.spent.tolist() == [0, 3, 0, 0, 7, 0]
    assert some.spent.tolist() == [7, 3]
    assert (oracle.remaining - some.remaining.min()).tolist() == [7, 4, 7, 7, 0, 7]
    spent, gradients, *_ = enforcer.counts
    assert spent.tolist() == oracle.spent.tolist()
    assert gradients.tolist() == [0, 0, 0, 0, 4, 0]


@at_any_size
@given(rows=st.lists(st.integers(0, BATCH - 1), min_size=1), data=st.data())
def test_a_selection_of_a_selection_has_the_limits_of_its_episodes(rows: list[int], data: st.DataObject) -> None:
    policy = stacked(victim("discrete"))
    oracle = opened(policy, remembered(policy, BATCH, 4))
    inner = data.draw(st.lists(st.integers(0, len(rows) - 1), unique=True).map(sorted))
    some, places = chosen(chosen(oracle, rows), inner), torch.tensor(rows)[inner]
    assert torch.equal(some.observation, oracle.observation[places])
    assert torch.equal(some.radius, oracle.radius[places])
    far = 9 * asked_about((2,), BATCH)
    assert torch.equal(some.project(far[:, places]), oracle.project(far)[:, places])


def test_the_episodes_of_a_selection_pay_once_for_each_time_they_are_named() -> None:
    policy = stacked(victim("discrete"))
    oracle = opened(policy, remembered(policy, BATCH, 4))
    chosen(oracle, [2, 2, 2, 5]).scores(asked_about((), 4))
    assert oracle.spent.tolist() == [0, 0, 3, 0, 0, 1]


@pytest.mark.parametrize("rows", [torch.tensor([0, BATCH]), torch.tensor([-1]), torch.ones(BATCH, dtype=torch.bool)])
def test_only_numbers_of_its_episodes_can_be_selected(rows: Tensor) -> None:
    policy = stacked(victim("discrete"))
    with pytest.raises(UserError, match=r"selected episodes by other than numbers from 0 to 5, int64 \[R\]"):
        opened(policy, remembered(policy, BATCH, 4)).select(rows)


def test_what_an_attack_does_to_its_rows_afterwards_changes_no_account() -> None:
    policy = stacked(victim("discrete"))
    oracle, rows = opened(policy, remembered(policy, BATCH, 4)), torch.tensor([1, 2])
    some = oracle.select(rows)
    rows.fill_(0)
    some.scores(asked_about((), 2))
    assert oracle.spent.tolist() == [0, 1, 1, 0, 0, 0]


def test_a_question_about_fewer_episodes_names_the_selection() -> None:
    policy = stacked(victim("discrete"))
    with pytest.raises(UserError, match=r"asked about 2 episodes, its oracle has 6: ask oracle\.select\(rows\)"):
        opened(policy, remembered(policy, BATCH, 4)).scores(asked_about((), 2))
