"""The rules for drivers, as victims are loaded and as defences make them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from bench.conformance.check import Check, NotApplicableError, Suite, require
from bench.conformance.network import check_frozen, check_gradient, check_white_box, unchanged
from bench.conformance.traffic import observations
from bench.driving import DrivingVictim, DrivingWorld, Policy
from bench.scenarios import Cell

EPISODES = 6


class PolicySuite(Suite):
    """Of what a `DrivingVictim` or a `DrivingDefense` loads.

    Args:
        name: of the component.
        component: the victim or the defence.
        victim: the victim itself, or the one that the defence is tried on.
        load: gives the policy anew.
        world: whose observations it reads.
    """

    def __init__(
        self, name: str, component: Any, victim: DrivingVictim, load: Callable[[], Policy], world: DrivingWorld
    ) -> None:
        super().__init__(name, component)
        self.victim, self.load, self.features = victim, load, world.features
        env = world.make([Cell(lanes=3, density=1.0)])
        self.rows = env.observation_spec["observation"].shape[-2]
        env.close(raise_if_closed=False)

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
        policy = self.load()
        require(
            isinstance(policy, Policy), f"load returned a {type(policy).__name__}, not a bench.driving.contracts.Policy"
        )
        check_frozen(policy, "policy")
        require(
            policy.action_type == self.victim.action_type,
            f"the policy's action_type is {policy.action_type!r}, the victim's {self.victim.action_type!r}",
        )

    def shapes(self) -> None:
        """Scores for any leading dimensions: attacks ask about many points of many episodes at once."""
        policy, observation = self._ready(), self._observations()
        width = 2 if policy.action_type == "continuous" else None
        for asked in (observation, observation.expand(3, *observation.shape)):
            scores = policy.scores(asked)
            require(
                scores.ndim == asked.ndim - 1 and scores.shape[:-1] == asked.shape[:-2],
                f"scores has shape {list(scores.shape)} for {list(asked.shape)}: keep all dimensions but the last two",
            )
            require(
                width in (None, scores.shape[-1]), f"scores has {scores.shape[-1]} numbers, continuous actions are 2"
            )
            require(scores.dtype == asked.dtype, f"scores is {scores.dtype} for {asked.dtype}")
            require(bool(scores.isfinite().all()), "some scores are NaN or infinite")

    def decides(self) -> None:
        """Decisions are of the kind and range that the world takes."""
        policy, observation = self._ready(), self._observations()
        scores, action = policy.scores(observation), policy.decide(observation)
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
            torch.equal(policy.choose(scores), action) or not self.victim.sees,
            "choose(scores(observation)) is not decide(observation): override choose, or leave decide as it is",
        )

    def neighbours_do_not_matter(self) -> None:
        """What is decided in one episode does not depend on the others of the batch."""
        policy, among, others = self._ready(), self._observations(0), self._observations(1)
        others[0] = among[0]
        first, second = policy.scores(among)[0], policy.scores(others)[0]
        require(
            torch.allclose(first, second, rtol=1e-4, atol=1e-5),
            "the scores of an episode change with the others of the batch: is a batch normalisation in training mode?",
        )

    def same_seed_same_scores(self) -> None:
        """Loaded twice and asked twice, it says the same."""
        observation = self._observations()
        first = self._ready().scores(observation)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(1)
            policy = self._ready()
            second, again = policy.scores(observation), policy.scores(observation)
        require(
            torch.equal(first, second),
            "two loads with the same seed score differently: draw from a generator of its own, seeded in reset(seeds)",
        )
        require(torch.equal(second, again), "asked twice, it scores differently: scores must have no side effect")

    def looks(self) -> None:
        """A driver that ignores what it is shown says so, so that nobody attacks it."""
        scores = self._ready().scores(self._observations())
        same = torch.equal(scores[1:], scores[:-1])
        if not self.victim.sees:
            raise NotApplicableError("it says that it ignores what it is shown (sees = False)")
        require(not same, "its scores do not depend on what it sees: set sees = False")

    def differentiable(self) -> None:
        """White-box attacks find a way back to the observation."""
        if not self.victim.sees:
            raise NotApplicableError("it ignores what it is shown")
        check_white_box(self.victim)
        leaf = self._observations().requires_grad_(True)
        scores = self._ready().scores(leaf)
        require(scores.requires_grad, "its scores have no graph: no torch.no_grad in scores, no .detach, no NumPy")
        # Not their sum, which may be constant.
        weighted = scores @ torch.linspace(1, 2, scores.shape[-1])
        (gradient,) = torch.autograd.grad(weighted.sum(), leaf)
        check_gradient(gradient)

    def keeps_weights(self) -> None:
        """Loading and asking change nothing."""
        policy = self._ready()
        with unchanged(policy, partial(self.victim.load, 0)):
            policy.decide(self._observations())
            self.load()

    def _ready(self) -> Policy:
        policy = self.load()
        policy.reset(torch.arange(EPISODES))
        return policy

    def _observations(self, seed: int = 0) -> Tensor:
        return observations(EPISODES, features=self.features, rows=self.rows, seed=seed)
