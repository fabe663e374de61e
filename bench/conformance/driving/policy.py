"""The rules for policies, of victims and of defences, in one step."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from bench.conformance.check import Check, NotApplicableError, Subject, Suite, require
from bench.conformance.driving.traffic import observations, rows_of_observation
from bench.conformance.network import check_frozen, check_gradient, check_white_box, unchanged
from bench.driving import DrivingWorld, Policy, State

EPISODES = 6


class PolicySuite(Suite):
    """Of what a `DrivingVictim` or a `DrivingDefense` loads, in one step."""

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        self.victim = subject.victim
        self.world: DrivingWorld = subject.world
        self.rows = rows_of_observation(self.world)

    def checks(self) -> Mapping[str, Check]:
        return {
            "ready to drive": self.frozen,
            "shape and type": self.shapes,
            "decisions": self.decides,
            "batching": self.neighbours_do_not_matter,
            "determinism": self.same_seed_same_scores,
            "sees": self.looks,
            "gradient": self.differentiable,
            "weights left alone": self.keeps_weights,
        }

    def frozen(self) -> None:
        """Eval mode, no gradients on weights, of the action type it says."""
        policy = self.subject.load()
        require(isinstance(policy, Policy), f"load returned a {type(policy).__name__}, not a bench.driving.Policy")
        check_frozen(policy, "policy")
        require(
            policy.action_type == self.victim.action_type,
            f"the policy's action_type is {policy.action_type!r}, the victim's {self.victim.action_type!r}",
        )

    def shapes(self) -> None:
        """Scores for a batch of episodes and, without a memory, for any leading dimensions: attacks ask about many points."""
        policy, state, observation = *self._ready(), self._observations()
        width, why = 2, "continuous actions are 2"
        if policy.action_type == "discrete":
            width = len(self.world.facts.actions)
            why = f"the world has {width} actions: look at facts.actions"
        asked = [observation] if state is not None else [observation, observation.expand(3, *observation.shape)]
        for one in asked:
            scores = policy.scores(one, state)
            require(
                scores.ndim == one.ndim - 1 and scores.shape[:-1] == one.shape[:-2],
                f"scores has shape {list(scores.shape)} for {list(one.shape)}: keep all dimensions but the last two",
            )
            require(scores.shape[-1] == width, f"scores has {scores.shape[-1]} numbers, {why}")
            require(scores.dtype == one.dtype, f"scores is {scores.dtype} for {one.dtype}")
            require(bool(scores.isfinite().all()), "some scores are NaN or infinite")

    def decides(self) -> None:
        """Decisions are of the kind and range that the world takes."""
        policy, state, observation = *self._ready(), self._observations()
        scores, action = policy.scores(observation, state), policy.decide(observation, state)
        if policy.action_type == "discrete":
            require(action.dtype == torch.int64, f"decide gives {action.dtype}, discrete actions are int64")
            require(action.shape == observation.shape[:-2], f"decide gives shape {list(action.shape)}, not [B]")
            allowed = bool(((action >= 0) & (action < scores.shape[-1])).all())
            require(allowed, f"decide gives actions outside 0 to {scores.shape[-1] - 1}")
        else:
            require(
                action.shape == (*observation.shape[:-2], 2), f"decide gives shape {list(action.shape)}, not [B, 2]"
            )
            require(bool((action.abs() <= 1).all()), "decide gives actions outside [-1, 1]")
        require(
            torch.equal(policy.choose(scores), action),
            "choose(scores(observation, state)) is not decide(observation, state): override choose, or leave decide as it is",
        )

    def neighbours_do_not_matter(self) -> None:
        """What is decided in one episode does not depend on the others of the batch."""
        policy, state = self._ready()
        among, others = self._observations(0), self._observations(1)
        others[0] = among[0]
        first, second = policy.scores(among, state)[0], policy.scores(others, state)[0]
        require(
            torch.allclose(first, second, rtol=1e-4, atol=1e-5),
            "the scores of an episode change with the others of the batch: is a batch normalisation in training mode?",
        )

    def same_seed_same_scores(self) -> None:
        """Loaded twice and asked twice, it gives the same scores."""
        observation = self._observations()
        policy, state = self._ready()
        first = policy.scores(observation, state)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(1)
            policy, state = self._ready()
            second, again = policy.scores(observation, state), policy.scores(observation, state)
        require(
            torch.equal(first, second),
            "two loads with the same seed score differently: draw in initial(episodes), from a generator seeded by each episode",
        )
        require(torch.equal(second, again), "asked twice, it scores differently: scores must have no side effect")

    def looks(self) -> None:
        """A policy that ignores its input says so, so that nobody attacks it."""
        policy, state = self._ready()
        scores = policy.scores(self._observations(), state)
        same = torch.equal(scores[1:], scores[:-1])
        if not self.victim.sees:
            raise NotApplicableError("it ignores its input, and says so (sees = False)")
        require(not same, "its scores do not depend on its input: set sees = False")

    def differentiable(self) -> None:
        """White-box attacks need a gradient in the observation."""
        if not self.victim.sees:
            raise NotApplicableError("it ignores its input")
        check_white_box(self.victim)
        leaf = self._observations().requires_grad_(True)
        policy, state = self._ready()
        scores = policy.scores(leaf, state)
        require(scores.requires_grad, "its scores have no graph: no torch.no_grad in scores, no .detach, no NumPy")
        # Not their sum, which may be constant.
        weighted = scores @ torch.linspace(1, 2, scores.shape[-1])
        (gradient,) = torch.autograd.grad(weighted.sum(), leaf)
        check_gradient(gradient)

    def keeps_weights(self) -> None:
        """Loading and asking change nothing."""
        policy, state = self._ready()
        with unchanged(policy, self.subject.load_victim):
            policy.decide(self._observations(), state)
            self.subject.load()

    def _ready(self) -> tuple[Policy, State]:
        """The policy, loaded anew, and what it remembers before the first step."""
        policy = self.subject.load()
        return policy, policy.initial(torch.arange(EPISODES))

    def _observations(self, seed: int = 0) -> Tensor:
        return observations(EPISODES, features=self.world.features, rows=self.rows, seed=seed)
