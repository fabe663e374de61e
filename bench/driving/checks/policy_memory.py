"""Rules for the memory of policies, over several steps: all memory is in the state."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from cavbench.checks.check import Check, NotApplicableError, Subject, Suite, one_line, require
from cavbench.driving import ObservationThreat, Policy, State
from cavbench.driving.access import Enforcer
from cavbench.driving.checks.remembering import Remembering
from cavbench.driving.checks.state import ATOL, RTOL, check_state, close, named, not_noisy, same
from cavbench.driving.checks.traffic import observations, rows_of_observation
from cavbench.driving.policy import rows_of
from cavbench.driving.victim import CHUNK, CountedPolicy
from cavbench.errors import UserError
from cavbench.scenarios import SeedBlock

EPISODES, STEPS = 6, 3
SUBSETS = ((4,), (5, 0, 3), (2, 1))
"""Subsets of the episodes to query, in different orders."""
POINTS = CHUNK // EPISODES + 2
"""Points per episode: more than the oracle scores in one chunk, so that it splits the points of an episode."""
ON_THE_OBJECT = "keep memory in the state that initial and advance return, not on the object"


class PolicyMemorySuite(Suite):
    """Checks of the policy of a `DrivingVictim` or a `DrivingDefense`, with or without a memory."""

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        self.features, self.rows = subject.world.features, rows_of_observation(subject.world)

    def checks(self) -> Mapping[str, Check]:
        return {
            "memory": self.state_of_the_episodes,
            "memory, scores": self.scores_are_pure,
            "memory, subsets": self.any_subset_in_any_chunk,
            "memory, episodes": self.neighbours_do_not_matter,
            "memory, object": self.keeps_nothing,
            **({"memory of the victim": self.passes_on} if self.subject.kind == "defense" else {}),
        }

    def state_of_the_episodes(self) -> str:
        """The state is a TensorDict with one row per episode, or None for a policy without a memory."""
        policy = self.subject.load()
        first = policy.initial(_episodes())
        check_state(first, "initial", EPISODES)
        after = self._advanced(policy, first, 0)
        require(
            first is not None or after is None,
            "advance returns a state, but initial returned None: create the state in initial",
        )
        require(first is None or after is not None, "advance returns None: return the state of the next step")
        check_state(after, "advance", EPISODES)
        again = policy.initial(_episodes())
        require(
            same(first, again), "initial returns two states for the same episodes: draw from a seeded generator only"
        )
        return named(first)

    def scores_are_pure(self) -> None:
        """Scoring changes no state, and gives the same scores for the same input and state, also after the step."""
        policy = self.subject.load()
        not_noisy(policy)
        state = policy.initial(_episodes())
        for step in range(STEPS):
            before = None if state is None else state.clone()
            observation = self._observations(step)
            first = policy.scores(observation, state)
            policy.scores(self._observations(100), state)
            require(same(before, state), "scores changed its state argument: change the state in advance only")
            after = self._advanced(policy, state, step)
            require(same(before, state), "advance changed its state argument: return a new TensorDict")
            require(
                torch.equal(policy.scores(observation, state), first),
                f"it gives different scores for an earlier step: {ON_THE_OBJECT}",
            )
            state = after

    def any_subset_in_any_chunk(self) -> None:
        """Scores do not depend on which episodes are queried, in which order, and with how many points."""
        policy, state = self._after_some_steps()
        not_noisy(policy)
        observation = self._observations(STEPS)
        together = policy.scores(observation, state)
        for subset in SUBSETS:
            rows = torch.tensor(subset)
            alone = policy.scores(observation[rows], rows_of(state, rows))
            require(
                torch.allclose(alone, together[rows], rtol=RTOL, atol=ATOL),
                f"it gives different scores for the episodes {list(subset)} alone: use the rows of its state argument",
            )
            self._check_oracle(policy, state, rows)

    def _check_oracle(self, policy: Policy, state: State, rows: Tensor) -> None:
        """The oracle returns the scores of the policy."""
        observation = self._observations(STEPS)
        generator = torch.Generator().manual_seed(0)
        threat = ObservationThreat(queries=POINTS)
        oracle = Enforcer(CountedPolicy(policy), threat, "scores", self.features, generator).begin(observation, state)
        share = 2 * torch.rand(POINTS, *observation[rows].shape, generator=generator) - 1
        some = oracle.select(rows)
        points = some.project(some.observation + share * some.radius)
        answered = some.scores(points)
        for place in (0, POINTS - 1):
            asked = policy.scores(points[place], rows_of(state, rows))
            require(
                torch.allclose(answered[place], asked, rtol=RTOL, atol=ATOL),
                "it gives different scores for many points at once: row i of the state belongs to row i of the observation",
            )

    def neighbours_do_not_matter(self) -> None:
        """The state of an episode does not depend on the others of its batch."""
        _, state = self._after_some_steps()
        if state is None:
            raise NotApplicableError("it has no memory")
        for subset in SUBSETS:
            rows = torch.tensor(subset)
            alone = self._after_some_steps(rows)[1]
            require(
                close(alone, state[rows]),
                "the state of an episode depends on the others of its batch: create and advance it row by row",
            )

    def keeps_nothing(self) -> None:
        """The policy object stores no memory: other batches and queries in between change nothing."""
        policy, state = self._after_some_steps()
        not_noisy(policy)
        expected = policy.scores(self._observations(STEPS), state)
        asked = self.subject.load()
        state, other = asked.initial(_episodes()), asked.initial(_episodes() + EPISODES)
        for step in range(STEPS):
            for query in range(3):
                asked.scores(self._observations(200 + query), state)
            other = self._advanced(asked, other, 100 + step)
            state = self._advanced(asked, state, step)
        require(
            torch.equal(asked.scores(self._observations(STEPS), state), expected),
            f"other queries or batches in between change its scores: {ON_THE_OBJECT}",
        )

    def passes_on(self) -> None:
        """A defence passes on the state of a victim with a memory."""
        facts = self.subject.world.facts
        victim = Remembering(actions=self.subject.victim.action_type)
        try:
            policy = self.subject.component.load(victim, 0, facts)
        except (UserError, NotImplementedError) as error:
            raise NotApplicableError(f"it cannot be loaded for a victim with a memory: {one_line(error)}") from None
        before = state = policy.initial(_episodes())
        require(
            state is not None,
            "initial returns None for a victim with a memory: derive from PolicyWrapper, or return policy.initial(episodes)",
        )
        for step in range(STEPS):
            state = self._advanced(policy, state, step)
        first, last = (policy.scores(self._observations(STEPS), one) for one in (before, state))
        require(
            not torch.equal(first, last),
            "the victim's memory has no effect: pass the state to policy.scores, and call policy.advance",
        )

    def _after_some_steps(self, rows: Tensor | None = None) -> tuple[Policy, State]:
        """A newly loaded policy and its state after some steps of all episodes, or of `rows` alone."""
        policy = self.subject.load()
        state = policy.initial(_episodes() if rows is None else _episodes()[rows])
        for step in range(STEPS):
            state = self._advanced(policy, state, step, rows)
        return policy, state

    def _advanced(self, policy: Policy, state: State, step: int, rows: Tensor | None = None) -> State:
        """The state after one step, with the same observations and actions for every policy."""
        observation, action = self._observations(step), self._actions(policy, step)
        if rows is not None:
            observation, action = observation[rows], action[rows]
        return policy.advance(observation, action, state)

    def _actions(self, policy: Policy, step: int) -> Tensor:
        """Actions [B] or [B, 2], different for every episode."""
        number = torch.arange(EPISODES) + step
        if policy.action_type == "discrete":
            return number % len(self.subject.world.facts.actions)
        return torch.stack((number.sin(), number.cos()), -1)

    def _observations(self, step: int) -> Tensor:
        return observations(EPISODES, features=self.features, rows=self.rows, seed=step)


def _episodes() -> Tensor:
    return torch.arange(SeedBlock.REPORT, SeedBlock.REPORT + EPISODES)
