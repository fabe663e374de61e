"""Tries a driving policy on observations of its world before a run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.driving import DrivingWorld, Policy, State
from cavbench.driving.policy import repeated, rows_of
from cavbench.errors import UserError, reason
from cavbench.isolation.memory import changed, kept
from cavbench.isolation.streams import Stream
from cavbench.scenarios import Cell, SeedBlock

EPISODES, STEPS = 8, 30
"""The observations are of so many episodes, and of so many decisions with random actions."""
COPIES = 3
"""Simulated copies of each episode."""
MANY = 1500
"""A batch as large as those of attacks, which ask about many points of many episodes at once."""
TOLERANCE = 1e-3
"""Answers may differ by this share of their largest value between batches of different sizes: rounding."""
SAME = 1e-6
"""The same for equal batches."""
NEIGHBOURS, NEAR = 4, 0.02
"""So many points around an observation are asked, at most so far away on [-1, 1]."""
LOST = 0.5
"""Share of observations without a usable gradient from which on attacks with gradients say nothing."""


@dataclass(frozen=True)
class Moment:
    """What a policy is asked about at a moment of some episodes.

    Args:
        observation: [B, V, F].
        state: the policy's state, batch size [B]; None for a policy without one.
    """

    observation: Tensor
    state: State

    def of(self, rows: Tensor) -> Moment:
        """The same of the episodes `rows`, int64 [R] in any order."""
        return Moment(self.observation[rows], rows_of(self.state, rows))


def try_policy(
    policy: Policy, world: DrivingWorld, cells: Sequence[Cell], *, gradients: bool, random: bool
) -> list[str]:
    """Try what attacks, probes and replays rely on, on observations of the world with absent rows.

    Args:
        policy: the (defended) victim, as it is loaded; it is not driven afterwards.
        world: the world that it will drive in.
        cells: cells of the run.
        gradients: whether attacks may ask for gradients.
        random: whether it may draw from the random generators of the process, which is measured and flagged in the run.

    Returns:
        Warnings, each the end of a sentence that begins with the policy.

    Raises:
        UserError: the end of such a sentence, if its score would be wrong: it answers NaN, depends on the
            rest of the batch, or remembers what it is not given.
    """
    own = Stream("trial")
    with own.in_use():
        moments = []
        for moment in _moments(policy, _observed(world, tuple(cells), policy.action_type)):
            _try_answer(policy, world, moment)
            moments.append(moment)
        drew = _try_memory(policy, moments, own)
        if drew and not random:
            raise UserError(
                "draws random numbers, so no score of it could be repeated: take the most likely action, switch dropout off, or "
                "give a Policy that seeds a generator in initial(episodes)"
            )
        if not drew:
            for moment in moments:
                _try_batches(policy, moment)
            _try_rehearsal(policy, moments)
        told = _gradients(policy, moments) if gradients else []
        # Controls that are clipped do not change either.
        return told + (_clipped(policy, moments) or ([] if drew else _steps(policy, moments)))


@cache
def _observed(world: DrivingWorld, cells: Sequence[Cell], action_type: str) -> tuple[Tensor, ...]:
    """Observations [B, V, F] of successive decisions with random actions, in scenarios that are never reported."""
    spread = [cells[place * len(cells) // EPISODES] for place in range(EPISODES)]
    env = world.make(spread, action_type="discrete" if action_type == "discrete" else "continuous")
    generator = torch.Generator().manual_seed(0)
    found = []
    try:
        td = env.reset(TensorDict({"seed": torch.arange(EPISODES) + SeedBlock.TUNE}, batch_size=env.batch_size))
        for _ in range(STEPS):
            found.append(td["observation"])
            action = (
                torch.randint(len(world.actions), (EPISODES,), generator=generator)
                if action_type == "discrete"
                else torch.rand(EPISODES, len(world.facts.controls), generator=generator) * 0.2 - 0.1
            )
            td = env.step(td.set("action", action))["next"]
    finally:
        env.close(raise_if_closed=False)
    return tuple(found)


def _moments(policy: Policy, observed: Sequence[Tensor]) -> Iterator[Moment]:
    """The first moment, one in the middle and the last; and, where there are several rows, the last with most rows absent."""
    state = policy.initial(torch.arange(EPISODES))
    with torch.no_grad():
        for step, observation in enumerate(observed):
            if step in (0, len(observed) // 2, len(observed) - 1):
                yield Moment(observation.clone(), state)
            # An absent row is 0 everywhere, as in fog and on an empty road.
            if step == len(observed) - 1 and observation.shape[-2] > 1:
                empty = observation.clone()
                empty[: EPISODES // 2, 1:] = 0.0
                empty[EPISODES // 2 :, 2:] = 0.0
                yield Moment(empty, state)
            state = policy.advance(observation.clone(), policy.decide(observation.clone(), state), state)


def _answer(policy: Policy, moment: Moment) -> Tensor:
    """The scores of a moment; the policy gets copies."""
    with torch.no_grad():
        return policy.scores(moment.observation.clone(), None if moment.state is None else moment.state.clone())


def _try_answer(policy: Policy, world: DrivingWorld, moment: Moment) -> None:
    """Raise UserError if an answer is no tensor of finite numbers, one for each action."""
    scores = _answer(policy, moment)
    actions = world.facts.actions
    width = len(actions) if policy.action_type == "discrete" else len(world.facts.controls)
    if type(scores) is not Tensor or not scores.is_floating_point():
        raise UserError(
            f"answers {getattr(scores, 'dtype', type(scores).__name__)}; scores are a tensor of real numbers"
        )
    if scores.shape[:-1] == (EPISODES,) and policy.action_type == "discrete" and scores.shape[-1] != width:
        raise UserError(f"has {scores.shape[-1]} actions, the world has {width}: {', '.join(actions)}")
    if list(scores.shape) != [EPISODES, width]:
        raise UserError(
            f"answers {list(scores.shape)} for {list(moment.observation.shape)}; {policy.action_type} actions need "
            f"[{EPISODES}, {width}]"
        )
    if not bool(scores.isfinite().all()):
        raise UserError("answers NaN or infinity on observations of this world")


def _try_memory(policy: Policy, moments: Sequence[Moment], own: Stream) -> bool:
    """Whether it draws from the random generators of the process.

    Raises:
        UserError: if an answer depends on earlier calls, or a call leaves something behind.
    """
    # What is kept for each size of a batch is there after this.
    first = [_answer(policy, moment) for moment in moments]
    marks, before = own.marks(), kept(policy)
    left: list[str] = []
    for moment in moments:
        _answer(policy, moment.of(torch.arange(EPISODES).flip(0)))
        left = left or changed(before, kept(policy))
    again = [_answer(policy, moment) for moment in moments]
    drew = own.marks() != marks
    if left:
        raise UserError(
            f"remembers earlier calls in {left[0]!r}: attacks and probes ask it between two decisions, so what it remembers must "
            "be in its state (Policy.initial and Policy.advance; docs/plugins.md)"
        )
    if not drew and any(_apart(one, other, SAME) for one, other in zip(first, again, strict=True)):
        raise UserError(
            "answers otherwise when it is asked the same again: it remembers earlier calls, or draws random numbers; what it "
            "remembers must be in its state (Policy.initial and Policy.advance), and random numbers in a generator there"
        )
    return drew


def _try_batches(policy: Policy, moment: Moment) -> None:
    """Raise UserError if an answer depends on the rest of the batch, its size or its order."""
    whole = _answer(policy, moment)
    generator = torch.Generator().manual_seed(1)
    batches = {
        "alone": [torch.tensor([row]) for row in range(EPISODES)],
        "in another order": [torch.randperm(EPISODES, generator=generator)],
        "in a smaller batch": [torch.arange(3), torch.arange(EPISODES - 3, EPISODES)],
        "among other observations": [torch.tensor([row, *([0] * (EPISODES - 1))]) for row in (2, 5)],
        "in a large batch": [torch.randint(EPISODES, (MANY,), generator=generator)],
    }
    for where, parts in batches.items():
        for rows in parts:
            if _apart(_answer(policy, moment.of(rows)), whole[rows], TOLERANCE):
                raise UserError(
                    f"answers otherwise about an observation {where}: normalise and quantise by fixed statistics, not by those "
                    "of the batch (as quantize_dynamic does), and call eval() before an export"
                )


def _try_rehearsal(policy: Policy, moments: Sequence[Moment]) -> None:
    """Raise UserError if copies of an episode go on otherwise than the episode: attacks with dynamics simulate copies."""
    start = moments[0]
    if start.state is None:
        return
    many = Moment(torch.cat([start.observation] * COPIES), repeated(start.state, torch.Size([COPIES])))
    with torch.no_grad():
        for moment in moments[1:]:
            action = policy.choose(_answer(policy, start))
            state = policy.advance(start.observation.clone(), action, start.state)
            states = policy.advance(many.observation.clone(), torch.cat([action] * COPIES), many.state)
            start = Moment(moment.observation, state)
            many = Moment(torch.cat([moment.observation] * COPIES), states)
            if _apart(_answer(policy, many), torch.cat([_answer(policy, start)] * COPIES), TOLERANCE):
                raise UserError(
                    "goes on otherwise in a simulated copy of an episode: what `advance` keeps must depend on that episode only"
                )


def _gradients(policy: Policy, moments: Sequence[Moment]) -> list[str]:
    """Warnings about gradients that are 0, NaN or infinite where an attack may change the observation."""
    nothing = lost = asked = 0
    for moment in moments:
        measured = _gradient(policy, moment)[..., 1:]
        present = moment.observation[..., :1] > 0
        asked += len(measured)
        lost += int((~measured.isfinite() & present).flatten(1).any(1).sum())
        nothing += int(((measured == 0) | ~measured.isfinite() | ~present).flatten(1).all(1).sum())
    if nothing >= LOST * asked:
        return [
            f"has no gradient in {100 * nothing / asked:.0f} % of the observations it was tried on (rounding, argmax, detach, a "
            "sharp softmax): attacks with gradients cannot tell how robust it is; zo asks for scores only"
        ]
    if lost:
        return [
            f"has a gradient with NaN or infinity in {100 * lost / asked:.0f} % of the observations it was tried on (a root or a "
            "division at 0): attacks with gradients count such an entry as 0"
        ]
    return []


def _steps(policy: Policy, moments: Sequence[Moment]) -> list[str]:
    """A warning if the scores do not change around most observations, so that an attack that asks for them sees nothing."""
    generator = torch.Generator().manual_seed(2)
    same, asked = 0, 0
    for moment in moments:
        scores, still = _answer(policy, moment), torch.ones(EPISODES, dtype=torch.bool)
        for _ in range(NEIGHBOURS):
            moved = moment.observation.clone()
            moved[..., 1:] += (
                NEAR * (2 * torch.rand(moved[..., 1:].shape, generator=generator) - 1) * (moved[..., :1] > 0)
            )
            other = _answer(policy, Moment(moved, moment.state))
            still &= ((scores - other).abs() <= SAME * scores.abs().amax(-1, keepdim=True).clamp(min=1e-3)).all(-1)
        asked += EPISODES
        same += int(still.sum())
    if same < LOST * asked:
        return []
    return [
        f"answers the same scores at all points around {100 * same / asked:.0f} % of the observations it was tried on (one-hot, "
        "argmax, a sharp softmax): attacks by scores, zo too, cannot tell how robust it is; give values or logits"
    ]


def _clipped(policy: Policy, moments: Sequence[Moment]) -> list[str]:
    """A warning if most controls of a policy from outside are clipped, as they are if it answers in units of physics."""
    if not getattr(policy, "clips", False):
        return []
    ends = torch.cat([(_answer(policy, moment).abs() == 1).any(-1) for moment in moments])
    if float(share := ends.float().mean()) < LOST:
        return []
    return [
        f"answers controls at or beyond an end of [-1, 1] in {100 * share:.0f} % of the observations it was tried on, which are "
        "clipped: if it answers another range, or m/s2 and rad, give a network that scales them to [-1, 1]"
    ]


def _gradient(policy: Policy, moment: Moment) -> Tensor:
    """[B, V, F] the gradient of the scores; 0 where they have none.

    Raises:
        UserError: if the policy fails on an observation that requires a gradient.
    """
    leaf = moment.observation.clone().requires_grad_(True)
    try:
        with torch.enable_grad():
            scores = policy.scores(leaf, None if moment.state is None else moment.state.clone())
            if not scores.requires_grad:
                return torch.zeros_like(leaf)
            # Weighted, because the plain sum of the scores may be constant.
            weighted = scores @ torch.linspace(1, 2, scores.shape[-1])
            (gradient,) = torch.autograd.grad(weighted.sum(), leaf, allow_unused=True)
    # The policy may raise anything.
    except Exception as error:
        raise UserError(f"fails when an attack asks for its gradient: {reason(error)}") from error
    return torch.zeros_like(leaf) if gradient is None else gradient


def _apart(first: Tensor, second: Tensor, tolerance: float) -> bool:
    """Whether answers [N, A] differ by more than a share of their largest value."""
    if first.shape != second.shape:
        return True
    allowed = tolerance * second.abs().amax(-1, keepdim=True).clamp(min=1e-3)
    return not bool(((first - second).abs() <= allowed).all())
