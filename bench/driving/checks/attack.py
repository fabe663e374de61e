"""Rules for driving attacks, in one step."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from cavbench.checks.check import BrokenRuleError, Check, Suite, one_line, require
from cavbench.checks.randomness import stir_others
from cavbench.core import registry
from cavbench.core.contracts import QueryBudgetError
from cavbench.driving import ActionType, DrivingAttack, DrivingWorld, ObservationThreat, Policy
from cavbench.driving.access import Enforcer
from cavbench.driving.checks.traffic import action_types, observations, victim, viewed
from cavbench.driving.dynamics import Dynamics
from cavbench.driving.forgery import Forgery
from cavbench.driving.sets import Traffic
from cavbench.driving.victim import CountedPolicy
from cavbench.errors import UserError
from cavbench.identity.fingerprint import state_digest

EPISODES, CARS = 6, 3
BUDGETS = (0, 1, 2, 7, 50, 1000)
"""Query budgets per step that an attack must work with."""
WITHIN = 1e-5
"""Rounding tolerance for leaving the perturbation set, on the normalised scale."""


class AttackSuite(Suite):
    """Checks of a `DrivingAttack` in the first step of an episode, on networks with random weights."""

    component: DrivingAttack

    def checks(self) -> Mapping[str, Check]:
        return {
            "shape, type and device": self.same_shape,
            "finite numbers": self.finite,
            "empty batch": self.nothing_to_do,
            "batching": self.neighbours_do_not_matter,
            "determinism": self.same_seed_same_answer,
            "threat model": self.within_the_set,
            "query budget": self.within_the_budget,
            "victim left alone": self.leaves_the_victim,
        }

    def same_shape(self) -> None:
        """The perturbed observation has the shape, dtype and device of the input [B, V, F]."""
        for action_type in action_types(self.subject):
            for dtype in (torch.float32, torch.float64):
                policy, observation = self._victim(action_type).to(dtype), self._observations().to(dtype)
                answer, _ = self._answer(policy, observation)
                require(isinstance(answer, Tensor), f"{self._method} returned a {type(answer).__name__}, not a tensor")
                require(
                    answer.shape == observation.shape,
                    f"{self._method} returned shape {list(answer.shape)} for {list(observation.shape)}: return [B, V, F]",
                )
                require(
                    (answer.dtype, answer.device) == (dtype, observation.device),
                    f"{self._method} returned {answer.dtype} on {answer.device} for {dtype} on {observation.device}: "
                    "make new tensors with observation.new_zeros or torch.zeros_like",
                )
                require(not answer.requires_grad, "the answer carries a graph: return answer.detach()")

    def finite(self) -> None:
        """The answer contains neither NaN nor infinity."""
        for action_type in action_types(self.subject):
            answer, _ = self._answer(self._victim(action_type), self._observations())
            broken = int((~answer.isfinite()).sum())
            require(not broken, f"{broken} of {answer.numel()} values of the answer are NaN or infinite")

    def nothing_to_do(self) -> None:
        """It accepts an empty batch: no episode is running any more."""
        for action_type in action_types(self.subject):
            answer, _ = self._answer(self._victim(action_type), self._observations()[:0])
            require(
                answer.shape[0] == 0,
                f"{self._method} returned {answer.shape[0]} for an empty batch: if not len(observation): return observation",
            )

    def neighbours_do_not_matter(self) -> None:
        """The answer for an episode does not depend on the others; in double precision, so that rounding changes no sign."""
        for action_type in action_types(self.subject):
            policy = self._victim(action_type).double()
            among, others = self._observations(0).double(), self._observations(1).double()
            others[0] = among[0]
            for threat in (self._threat(), self._threat(queries=30)):
                answers = [self._answer(policy, batch, threat) for batch in (among, others)]
                first, second = (answer for answer, _ in answers)
                mine, again = (enforcer.orders for _, enforcer in answers)
                require(
                    mine is None or again is None or torch.equal(mine[0], again[0]),
                    "the orders to the cars of an episode depend on the other episodes of its batch",
                )
                require(
                    torch.allclose(first[0], second[0], atol=1e-9),
                    "the answer for an episode depends on the others of its batch: compute means, norms, best points and "
                    "random numbers per episode, not over the batch",
                )

    def same_seed_same_answer(self) -> None:
        """All random numbers come from the generator of the run."""
        for action_type in action_types(self.subject):
            policy, observation = self._victim(action_type), self._observations()
            answers = []
            for seed in (1, 2):
                with torch.random.fork_rng(devices=[]):
                    torch.manual_seed(seed)
                    stir_others(seed)
                    answers.append(self._answer(policy, observation)[0])
            require(
                torch.equal(*answers),
                "the same seed gave two answers: draw with generator=oracle.generator, and store nothing on the object",
            )

    def within_the_set(self) -> str:
        """The oracle projects answers to the perturbation set; records contain how far outside they were."""
        outside = 0.0
        for action_type in action_types(self.subject):
            for threat in (self._threat(), self._threat(norm="linf", budget=0.2), self._threat(budget=0.0)):
                policy, observation = self._victim(action_type), self._observations()
                answer, enforcer = self._answer(policy, observation, threat)
                shown, _ = enforcer.project(answer)
                radius = threat.radius(observation, self.subject.world.features)
                require(
                    bool(((shown - observation).abs() <= radius + WITHIN).all()),
                    "the projected answer is outside the perturbation set",
                )
                outside = max(outside, float((answer - shown).abs().max()))
        if outside > WITHIN:
            return f"up to {outside:.2g} outside the set, projected by the oracle: return oracle.project(answer) to avoid it"
        return ""

    def within_the_budget(self) -> str:
        """It works within any query budget."""
        most = 0
        for action_type in action_types(self.subject):
            policy, observation = self._victim(action_type), self._observations()
            for queries in BUDGETS:
                try:
                    _, enforcer = self._answer(policy, observation, self._threat(queries=queries))
                except QueryBudgetError as error:
                    raise BrokenRuleError(
                        f"{one_line(error)}: check oracle.remaining before a query, and return the best answer so far"
                    ) from None
                most = max(most, int(enforcer.counts[0].max()))
        return f"{most} of 1000 queries per step"

    def leaves_the_victim(self) -> None:
        """It changes neither the weights, mode or gradients of the victim nor the true observation."""
        for action_type in action_types(self.subject):
            policy, observation = self._victim(action_type), self._observations()
            before, truth = (state_digest(policy), _marks(policy)), observation.clone()
            self._answer(policy, observation)
            require(
                state_digest(policy) == before[0], "the victim's weights changed: the attack may only query the oracle"
            )
            require(
                _marks(policy) == before[1],
                "the victim's mode or gradients changed: the attack may only query the oracle",
            )
            require(torch.equal(observation, truth), "the true observation was changed in place: work on a clone")

    @property
    def _method(self) -> str:
        """The method that the attack implements."""
        return "perturb" if type(self.component).step is DrivingAttack.step else "step"

    def _victim(self, action_type: ActionType) -> Policy:
        return victim(action_type, self.subject.world.facts)

    def _observations(self, seed: int = 0) -> Tensor:
        return observations(EPISODES, features=self.subject.world.features, seed=seed)

    def _threat(self, **values: Any) -> ObservationThreat:
        return allowing(self.component, **values)

    def _answer(
        self, policy: Policy, observation: Tensor, threat: ObservationThreat | None = None
    ) -> tuple[Tensor, Enforcer]:
        generator = torch.Generator().manual_seed(0)
        enforcer = Enforcer(
            CountedPolicy(policy),
            threat or self._threat(),
            self.component.access,
            self.subject.world.features,
            generator,
            dynamics(self.component, self.subject.world, policy.action_type, len(observation)),
        )
        oracle = enforcer.begin(observation, view=viewed(self.component, observation, self.subject.world.features))
        try:
            with torch.no_grad():
                state = self.component.initial(observation, oracle)
                answer = self.component.step(observation, oracle, state)[0]
                return enforcer.project(answer)[0] if isinstance(answer, Forgery) else answer, enforcer
        except QueryBudgetError:
            raise
        except UserError as error:
            raise BrokenRuleError(one_line(error)) from None


def allowing(attack: DrivingAttack, **values: Any) -> ObservationThreat:
    """A threat model that allows the attack's access."""
    threat = ObservationThreat(**values)
    if attack.drives:
        threat = replace(threat, traffic=Traffic(cars=CARS))
    return threat if threat.allows(attack.access) else replace(threat, access=attack.access)


def dynamics(attack: DrivingAttack, world: DrivingWorld, action_type: ActionType, episodes: int) -> Dynamics | None:
    """The dynamics of some episodes in the world's first cell, if the attack has access to them."""
    cells = [registry.grid_of(world).cells()[0]] * max(1, episodes)
    return world.dynamics(cells, action_type) if attack.access == "dynamics" else None


def _marks(policy: Policy) -> object:
    return [
        (name, weight.requires_grad, deepcopy(weight.grad)) for name, weight in policy.named_parameters()
    ], policy.training
