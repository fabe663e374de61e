"""An attack on single observations, outside of a run: the same oracle, threat model and counting."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cavbench.core import sets
from cavbench.core.pair import Pair
from cavbench.driving.attacker import Attacker, Shown
from cavbench.driving.contracts import DrivingWorld
from cavbench.driving.features import DrivingFacts
from cavbench.driving.policy import Policy
from cavbench.driving.threat import ObservationThreat
from cavbench.driving.victim import CountedPolicy
from cavbench.errors import UserError
from cavbench.isolation.modes import usual
from cavbench.isolation.streams import Stream, put_back
from cavbench.isolation.watch import Watch
from cavbench.scenarios import Cell

ROUNDING = 1e-5
"""A share of a range may be so far outside of [-1, 1]."""
ON_THE_ROAD = ("actuator", "traffic", "dynamics")
"""Sets of a threat model that change what cars do, which nobody who looks at observations alone can carry out."""


@dataclass(frozen=True)
class Attacked:
    """What an attack made of an observation, and what it cost; of several observations arrays [B].

    Args:
        observation: the perturbed observation, in the form of the given one, within the threat model.
        queries: evaluations of the victim.
        gradients: how many of these computed a gradient.
        size: largest deviation of a value, on the [-1, 1] scale.
        excess: how far the attack's answer was outside of the perturbation set before it was projected.
        clean, taken: the victim's decision on the true observation and on the perturbed one.
        milliseconds: wall time of the attack.
    """

    observation: Any
    queries: Any
    gradients: Any
    size: Any
    excess: Any
    clean: Any
    taken: Any
    milliseconds: float

    @property
    def changed(self) -> Any:
        """Whether the attack changed the decision: another discrete action, or any other control."""
        differ = np.asarray(self.clean) != np.asarray(self.taken)
        controls = differ.ndim - np.ndim(self.queries)
        found = differ.any(-1) if controls else differ
        return found if np.ndim(self.queries) else bool(found)


class Session:
    """An attack on a policy in one or more episodes, step by step; the attack's and the policy's states go on.

    Args:
        pair: the attack, the defended victim, the world and the threat model; it says what does not fit.
        policy: the defended policy.
        cells: the cell of each episode [B], for attacks with access to the dynamics of the world.
        seed: of the attack's random numbers.

    Raises:
        UserError: if the threat model does not allow what the attack needs, or has a set that only a run carries out.
    """

    def __init__(self, pair: Pair, policy: Policy, cells: Sequence[Cell], seed: int = 0) -> None:
        world: Any = pair.world.component
        threat: Any = pair.threat
        assert isinstance(world, DrivingWorld)
        assert isinstance(threat, ObservationThreat)
        if beyond := [name for name in sets.present(threat) if name in ON_THE_ROAD]:
            raise UserError(
                f"threat.{beyond[0]} changes what cars do, not what is observed: only a run carries it out "
                "(cavbench.score or bench run)"
            )
        self.facts, self.policy = world.facts, policy
        attack: Any = None if pair.is_clean else pair.armed(0)
        knows = attack is not None and attack.access == "dynamics"
        dynamics = world.dynamics(cells, policy.action_type) if knows else None
        self.watch = Watch(policy, "victim", listens=attack is not None)
        self.subject = CountedPolicy(policy, self.watch, Stream("attack", seed))
        frames = None if threat.share == 1 else threat.frames(self.facts.max_steps)
        self.attacker = Attacker(
            attack,
            self.subject,
            threat,
            self.facts.features,
            seed=seed,
            dynamics=dynamics,
            frames=frames,
            period=1 / self.facts.decision_hz,
            steps=self.facts.max_steps,
            actions=len(self.facts.actions),
        )
        self.state = self.subject.initial(torch.arange(len(cells)))
        self._stream = Stream("victim", seed)

    @usual()
    def show(self, observation: Tensor) -> tuple[Shown, Tensor, Tensor]:
        """Attack observations [B, V, F]: what the victim is shown, and its decisions on the truth and on that.

        A random victim draws the same for both.
        """
        running = torch.ones(len(observation), dtype=torch.bool)
        with torch.no_grad(), self._stream.in_use(), self.watch:
            if not self.attacker.begun:
                # As in a run: is it random? Then an attack asks several times about each point.
                self.subject.aside(observation, self.state)
            shown = self.attacker.show(observation, running, self.state)
            with put_back():
                clean = self.subject.decided(observation, self.state)
            taken = self.subject.decided(shown.observation, self.state)
        return shown, clean, taken

    @usual()
    def advance(self, shown: Tensor, action: Tensor) -> None:
        """Tell a policy with a memory what it was shown and what was done."""
        with torch.no_grad(), self._stream.in_use(), self.watch:
            self.state = self.subject.advance(shown, action, self.state)


class Form:
    """The form in which observations are given: of the world [V, F], or of its own environment; one, or a batch of them.

    Args:
        facts: facts of the world.
        given: observations: an array or a tensor.

    Raises:
        UserError: if it is neither form, or its numbers cannot be those of the world.
    """

    def __init__(self, facts: DrivingFacts, given: Any) -> None:
        self.facts, self.tensor = facts, isinstance(given, Tensor)
        with suppress(TypeError, ValueError):
            self.values = given.detach().cpu() if self.tensor else torch.from_numpy(np.array(given, np.float32))
        if not hasattr(self, "values"):
            raise UserError(f"an observation is an array or a tensor of numbers, got {type(given).__name__}")
        width = 1 + len(facts.features.names)
        own = (1, width) if facts.flat else (facts.rows, width)
        native = tuple(facts.native(torch.zeros(1, 1, width)).shape[1:]) if facts.flat else ()
        shape = tuple(self.values.shape)
        self.native = bool(native) and shape[-len(native) :] == native and len(shape) <= len(native) + 1
        one = native if self.native else own
        fits = all(
            found == wanted for found, wanted in zip(shape[-len(one) :], one, strict=False) if wanted is not None
        )
        if not (fits and len(shape) in (len(one), len(one) + 1)):
            listed = " or ".join(str(list(form)) for form in filter(None, (native, own)))
            listed = listed.replace("None", "V")
            raise UserError(
                f"an observation of this world has the shape {listed}, or [B, …] for several, got {list(shape)}"
            )
        if not bool(self.values.isfinite().all()):
            raise UserError("the observation contains NaN or infinity")
        if not self.native and float(self.values.abs().max()) > 1 + ROUNDING:
            raise UserError(
                "the observation has numbers outside of [-1, 1]: those of this world are shares of its ranges, as its "
                "environment in cavbench.gym returns them"
            )
        self.single = len(shape) == len(one)
        self.dtype = given.dtype

    def shown(self) -> Tensor:
        """The observations as policies get them, float32 [B, V, F]."""
        values = self.values.float().unsqueeze(0) if self.single else self.values.float()
        if not self.native:
            return values.contiguous()
        measured = self.facts.features.normalised(values.flatten(1)).clamp(-1, 1)
        return torch.cat((torch.ones(len(values), 1), measured), -1).unsqueeze(1)

    def back(self, observation: Tensor, truth: Tensor) -> Any:
        """Observations [B, V, F] in the form of the given ones. What was not changed is what was given, to the last bit."""
        found = self.facts.native(observation) if self.native else observation
        same = self.facts.native(truth) if self.native else truth
        found = torch.where(found == same, self.values.reshape(found.shape).to(found), found)
        found = found.reshape(self.values.shape)
        return found.to(self.dtype) if self.tensor else found.numpy().astype(self.dtype)

    def each(self, values: Tensor) -> Any:
        """A value for each observation [B, ...]; of a single one without B."""
        found = values.numpy()
        return found[0] if self.single else found
