"""Rules for the policies of victims and defences, in one step."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from cavbench.checks.check import BrokenRuleError, Check, NotApplicableError, Subject, Suite, one_line, require
from cavbench.checks.network import check_frozen, check_gradient, check_white_box, unchanged
from cavbench.checks.scenarios import first_cell
from cavbench.driving import DrivingWorld, Policy, State
from cavbench.driving.checks.state import not_noisy
from cavbench.driving.checks.traffic import observations, rows_of_observation
from cavbench.driving.trial import try_policy
from cavbench.errors import UserError

EPISODES = 6


class PolicySuite(Suite):
    """Checks of the policy of a `DrivingVictim` or a `DrivingDefense`, in one step."""

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
            "as a run tries it": self.tried,
        }

    def frozen(self) -> None:
        """The policy is in eval mode, has weights without gradients, and has the victim's action type."""
        policy = self.subject.load()
        require(isinstance(policy, Policy), f"load returned a {type(policy).__name__}, not a cavbench.driving.Policy")
        check_frozen(policy, "policy")
        require(
            policy.action_type == self.victim.action_type,
            f"the policy's action_type is {policy.action_type!r}, but the victim's is {self.victim.action_type!r}",
        )

    def shapes(self) -> None:
        """Scores have the right shape for a batch and, without a memory, for any leading dimensions, which attacks use."""
        policy, state, observation = *self._ready(), self._observations()
        width = len(self.world.facts.controls)
        why = f"but continuous actions have {width}"
        if policy.action_type == "discrete":
            width = len(self.world.facts.actions)
            why = f"but the world has {width} actions: use facts.actions"
        asked = [observation] if state is not None else [observation, observation.expand(3, *observation.shape)]
        for one in asked:
            scores = policy.scores(one, state)
            require(
                scores.ndim == one.ndim - 1 and scores.shape[:-1] == one.shape[:-2],
                f"scores has shape {list(scores.shape)} for {list(one.shape)}: keep all dimensions but the last two",
            )
            require(scores.shape[-1] == width, f"scores has {scores.shape[-1]} values, {why}")
            require(scores.dtype == one.dtype, f"scores is {scores.dtype} for {one.dtype}")
            require(bool(scores.isfinite().all()), "some scores are NaN or infinite")

    def decides(self) -> None:
        """Decisions have the type and the range of the world's actions."""
        policy, state, observation = *self._ready(), self._observations()
        scores, action = policy.scores(observation, state), policy.decide(observation, state)
        if policy.action_type == "discrete":
            require(action.dtype == torch.int64, f"decide returns {action.dtype}, but discrete actions are int64")
            require(action.shape == observation.shape[:-2], f"decide returns shape {list(action.shape)}, not [B]")
            allowed = bool(((action >= 0) & (action < scores.shape[-1])).all())
            require(allowed, f"decide returns actions outside 0 to {scores.shape[-1] - 1}")
        else:
            require(
                action.shape == (*observation.shape[:-2], scores.shape[-1]),
                f"decide returns shape {list(action.shape)}, not [B, {scores.shape[-1]}]",
            )
            require(bool((action.abs() <= 1).all()), "decide returns actions outside [-1, 1]")
        not_noisy(policy)
        require(
            torch.equal(policy.choose(scores), action),
            "choose(scores(observation, state)) differs from decide(observation, state): override choose, not decide",
        )

    def neighbours_do_not_matter(self) -> None:
        """The scores of an episode do not depend on the others of its batch."""
        policy, state = self._ready()
        among, others = self._observations(0), self._observations(1)
        others[0] = among[0]
        first, second = policy.scores(among, state)[0], policy.scores(others, state)[0]
        require(
            torch.allclose(first, second, rtol=1e-4, atol=1e-5),
            "the scores of an episode depend on the others of its batch: is a batch normalisation in training mode?",
        )

    def same_seed_same_scores(self) -> None:
        """Two loads and two calls give the same scores."""
        observation = self._observations()
        policy, state = self._ready()
        not_noisy(policy)
        first = policy.scores(observation, state)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(1)
            policy, state = self._ready()
            second, again = policy.scores(observation, state), policy.scores(observation, state)
        require(
            torch.equal(first, second),
            "two loads with the same seed give different scores: draw in initial(episodes), with one generator per episode seed",
        )
        require(torch.equal(second, again), "two calls give different scores: scores must have no side effect")

    def looks(self) -> None:
        """A policy that ignores its input declares sees = False, so that it is not attacked."""
        policy, state = self._ready()
        scores = policy.scores(self._observations(), state)
        same = torch.equal(scores[1:], scores[:-1])
        if not self.victim.sees:
            raise NotApplicableError("it ignores its input, as declared (sees = False)")
        require(not same, "its scores do not depend on its input: set sees = False")

    def differentiable(self) -> None:
        """Its scores have a gradient with respect to the observation, which white-box attacks need."""
        if not self.victim.sees:
            raise NotApplicableError("it ignores its input")
        check_white_box(self.victim)
        leaf = self._observations().requires_grad_(True)
        policy, state = self._ready()
        scores = policy.scores(leaf, state)
        require(scores.requires_grad, "its scores have no graph: do not use torch.no_grad, .detach or NumPy in scores")
        # Weighted, because the plain sum of the scores may be constant.
        weighted = scores @ torch.linspace(1, 2, scores.shape[-1])
        (gradient,) = torch.autograd.grad(weighted.sum(), leaf)
        check_gradient(gradient)

    def keeps_weights(self) -> None:
        """Loading and calling it changes no weights."""
        policy, state = self._ready()
        with unchanged(policy, self.subject.load_victim):
            policy.decide(self._observations(), state)
            self.subject.load()

    def tried(self) -> str:
        """A run would not refuse it: no memory outside of its state, and one answer in every batch and every copy."""
        if not self.victim.sees:
            raise NotApplicableError("it ignores its input")
        gradients = self.victim.answers == "gradients"
        policy = self.subject.load()
        try:
            return "; ".join(try_policy(policy, self.world, [first_cell(self.world)], gradients=gradients, random=True))
        except UserError as error:
            raise BrokenRuleError(f"a run refuses it: it {one_line(error)}") from None

    def _ready(self) -> tuple[Policy, State]:
        """A newly loaded policy and its initial state."""
        policy = self.subject.load()
        return policy, policy.initial(torch.arange(EPISODES))

    def _observations(self, seed: int = 0) -> Tensor:
        return observations(EPISODES, features=self.world.features, rows=self.rows, seed=seed)
