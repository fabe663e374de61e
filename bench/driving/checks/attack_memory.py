"""Rules for the memory of driving attacks, over several steps."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cavbench.checks.check import Check, Suite, refusals_are_broken_rules, require
from cavbench.driving import ActionType, DrivingAttack
from cavbench.driving.attacker import Attacker
from cavbench.driving.checks.attack import allowing, dynamics
from cavbench.driving.checks.state import check_state, named
from cavbench.driving.checks.traffic import action_types, observations, victim, viewed
from cavbench.driving.victim import CountedPolicy

EPISODES, STEPS = 6, 4
ENDING, ENDED_AT = (1, 4), 2
"""Episodes that end early, and the first step after their end."""


class AttackMemorySuite(Suite):
    """Checks of a `DrivingAttack`, with or without a memory, as in a run."""

    component: DrivingAttack

    def checks(self) -> Mapping[str, Check]:
        return {
            "memory": self.state_of_the_episodes,
            "memory, episodes": self.ended_episodes_do_not_matter,
            "memory, object": self.keeps_nothing,
        }

    def state_of_the_episodes(self) -> str:
        """The state is a TensorDict with one row per episode, from the first step on; creating it costs no query."""
        for action_type in action_types(self.subject):
            observation = self._observations()[0]
            oracle = self._attacker(action_type).enforcer.begin(
                observation, view=viewed(self.component, observation, self.subject.world.features)
            )
            with torch.no_grad(), refusals_are_broken_rules():
                first = self.component.initial(observation, oracle)
                require(
                    not oracle.spent.any(), "initial queried the victim: query it in step, where queries are counted"
                )
                check_state(first, "initial", EPISODES)
                answer = self.component.step(observation, oracle, first)
            require(
                isinstance(answer, tuple) and len(answer) == 2,
                "step must return a tuple: the perturbed observation, and the state",
            )
            _check_step(first, answer[1])
        return named(first)

    def ended_episodes_do_not_matter(self) -> None:
        """The state of an episode does not depend on episodes that have ended."""
        changed = self._observations()
        changed[:ENDED_AT, list(ENDING)] = self._observations(seed=100)[:ENDED_AT, list(ENDING)]
        kept = [episode for episode in range(EPISODES) if episode not in ENDING]
        for action_type in action_types(self.subject):
            first, second = (
                torch.stack(self._shown(action_type, batch))[:, kept] for batch in (self._observations(), changed)
            )
            require(
                torch.allclose(first, second, atol=1e-9),
                "the perturbation of an episode depends on episodes that have ended: keep memory in the state that initial "
                "and step return, one row per episode",
            )

    def keeps_nothing(self) -> None:
        """The attack object stores no memory: many runs use it at once."""
        for action_type in action_types(self.subject):
            alone = self._shown(action_type, self._observations())
            beside = self._shown(action_type, self._observations(), beside=self._observations(seed=100))
            require(
                all(torch.equal(one, other) for one, other in zip(alone, beside, strict=True)),
                "another run with the same attack object changes the perturbation: keep memory in the state that initial and "
                "step return, not on the object",
            )

    def _shown(self, action_type: ActionType, batch: Tensor, beside: Tensor | None = None) -> list[Tensor]:
        """The perturbed observations of a batch [STEPS, B, V, F] at every step, while another run alternates with it."""
        runs = [self._attacker(action_type)] + ([] if beside is None else [self._attacker(action_type, seed=1)])
        running = torch.ones(EPISODES, dtype=torch.bool)
        shown = []
        for step in range(STEPS):
            running[list(ENDING)] = step < ENDED_AT
            for run, seen in zip(runs, (batch, beside), strict=False):
                assert seen is not None
                with torch.no_grad(), refusals_are_broken_rules():
                    view = viewed(self.component, seen[step], self.subject.world.features)
                    answer = run.show(seen[step], running, None, view)
                if run is runs[0]:
                    shown.append(answer.observation)
        return shown

    def _attacker(self, action_type: ActionType, seed: int = 0) -> Attacker:
        facts = self.subject.world.facts
        policy = victim(action_type, facts).double()
        threat = allowing(self.component)
        moves = dynamics(self.component, self.subject.world, action_type, EPISODES)
        return Attacker(self.component, CountedPolicy(policy), threat, facts.features, seed=seed, dynamics=moves)

    def _observations(self, seed: int = 0) -> Tensor:
        """Observations [STEPS, B, V, F] in double precision, so that rounding changes no sign."""
        features = self.subject.world.features
        steps = [observations(EPISODES, features=features, seed=seed + step) for step in range(STEPS)]
        return torch.stack(steps).double()


def _check_step(before: TensorDictBase | None, after: TensorDictBase | None) -> None:
    """Raise BrokenRuleError if a step changes the structure of the state."""
    require(
        before is not None or after is None,
        "step returns a state, but initial returned None: create the state in initial",
    )
    require(
        before is None or after is not None, "step returns None as the state: return the state even if it is unchanged"
    )
    check_state(after, "step", EPISODES)
    if before is None or after is None:
        return
    forms = [{name: (value.dtype, value.shape) for name, value in state.items(True, True)} for state in (before, after)]
    require(forms[0] == forms[1], "step changed names, types or shapes in the state: keep those of initial")
