"""Drive one batch of episodes with a victim under attack, and return one row of measurements per episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from cavbench.core import sets
from cavbench.core.progress import share_done
from cavbench.driving.attacker import Attacker, Shown
from cavbench.driving.blame import Deeds, Judge, unknown
from cavbench.driving.contracts import DrivingAttack
from cavbench.driving.draws import Draws
from cavbench.driving.dynamics import Dynamics
from cavbench.driving.features import DrivingFacts
from cavbench.driving.meter import Columns, Meter
from cavbench.driving.policy import Policy, State, rows_of
from cavbench.driving.probes import Probe
from cavbench.driving.surroundings import USUAL
from cavbench.driving.threat import ObservationThreat
from cavbench.driving.traffic import View
from cavbench.driving.victim import CountedPolicy
from cavbench.errors import UserError
from cavbench.isolation.identifiers import opaque
from cavbench.isolation.kept import unchanged
from cavbench.isolation.streams import Stream
from cavbench.isolation.watch import Watch


class NotJointError(Exception):
    """Several units cannot be driven in one batch with the results that each has alone."""


LARGEST = 90
"""A victim's answers must be the same in every batch up to this size, if several units are driven together."""


@dataclass
class Trace:
    """Every step of some episodes of the batch, for recordings: `steps[name][t]` is an array [len(episodes), ...]."""

    episodes: Sequence[int]
    steps: dict[str, list[NDArray[np.generic]]] = field(default_factory=dict)

    def append(self, values: Mapping[str, Tensor]) -> None:
        """Append one step, given as tensors [B, ...] of the whole batch."""
        for name, value in values.items():
            self.steps.setdefault(name, []).append(value[list(self.episodes)].detach().numpy().copy())

    def by_episode(self, seeds: Sequence[int]) -> dict[int, Trace]:
        """One trace for each episode, by scenario seed."""
        return {
            seed: Trace([episode], {name: [step[[place]] for step in steps] for name, steps in self.steps.items()})
            for place, (seed, episode) in enumerate(zip(seeds, self.episodes, strict=True))
        }


def rollout(
    env: EnvBase,
    policy: Policy,
    attack: DrivingAttack | None,
    threat: ObservationThreat,
    seeds: Sequence[int],
    *,
    facts: DrivingFacts,
    attack_seed: int | Sequence[int],
    dynamics: Dynamics | None = None,
    entropy: int = 0,
    trace: Trace | None = None,
    judge: Judge | None = None,
) -> Columns:
    """Drive every episode of `env` once, to its end, and measure it.

    Args:
        env: a batched environment of a `DrivingWorld`, one episode a seed.
        policy: the (defended) victim.
        attack: the attack on the observations; None for no attack.
        threat: threat model, enforced on the attack.
        seeds: the scenario seed of each episode [B].
        facts: facts of the world.
        attack_seed: seed of the attack's random generator; for several units in one batch one seed for each episode: episodes
            with the same seed are one unit, and stand together.
        dynamics: the world's rules of motion, for attacks with that access; None if the world does not offer them.
        entropy: seed of the steps that are probed, which a victim must not be able to foresee; no measurement depends on it.
        trace: collects every step of its episodes.
        judge: says who is to blame for crashes, where the attack drives cars or the traffic does not drive as usual.

    Returns:
        One column [B] for each measurement; `cavbench.driving.track` has the names and units.

    Raises:
        UserError: if the numbers of actions of the victim and the world differ, or the victim answers NaN or infinity.
        TamperError: if the attack or the victim changes what it may not change.
        NotJointError: if there are several units, and the victim's answers depend on the rest of the batch, or anything was
            drawn from the random generators of the process, which the units share.
    """
    # The run's own: the objects that it was given may be reached by an attack or a victim.
    facts, threat = deepcopy(facts), deepcopy(threat)
    frames = threat.frames(facts.max_steps)
    episodes = torch.as_tensor(list(seeds), dtype=torch.int64)
    salts = [attack_seed] * len(seeds) if isinstance(attack_seed, int) else list(attack_seed)
    several = len(set(salts)) > 1
    victims_draws, attacks_draws = Stream("victim", salts[0]), Stream("attack", salts[0])
    with (
        # Without it a caller's inference mode leaves no gradient to an attack.
        torch.inference_mode(False),
        torch.no_grad(),
        victims_draws.in_use(),
        unchanged({type(attack).__name__: attack} if attack else {}, "attack"),
        Watch(policy, "victim", listens=attack is not None) as watch,
    ):
        keys = torch.cat([opaque([seed], ["draws", salt]) for seed, salt in zip(seeds, salts, strict=True)])
        subject = CountedPolicy(policy, watch, attacks_draws, Draws(keys))
        attacker = Attacker(
            attack,
            subject,
            threat,
            facts.features,
            seed=attack_seed,
            dynamics=dynamics,
            frames=frames,
            period=1 / facts.decision_hz,
            steps=facts.max_steps,
            actions=len(facts.actions),
        )
        td = env.reset(TensorDict({"seed": episodes}, batch_size=env.batch_size))
        state = subject.initial(torch.cat([opaque([seed], salt) for seed, salt in zip(seeds, salts, strict=True)]))
        deeds = Deeds(episodes.numpy())
        otherwise = attack is not None and (attack.drives or threat.dynamics != USUAL)
        meter = Meter(subject, facts, td["info", "x"].squeeze(-1), forges=bool(sets.present(threat)))
        probe = Probe(len(seeds), subject, entropy, rehearsed=attack is not None and attack.access == "dynamics")
        _check_actions(subject, td["observation"], state, facts)
        if several:
            gradients = attack is not None and attack.access in ("gradients", "dynamics")
            _check_rows(subject, td["observation"], state, gradients)
        for step in range(facts.max_steps):
            share_done(step / facts.max_steps)
            truth, running = td["observation"], ~td["done"].squeeze(-1)
            probing = probe.due()
            asked = attacker.enforcer.asked = [] if probing else None
            shown = attacker.show(truth, running, state, _view(attack, td))
            numbers = subject.numbers()
            unattacked = meter.unattacked(truth, shown, running, state, numbers)
            clean = None if trace is None else subject.aside(truth, state, numbers)
            if probing or probe.shadow:
                rehearsal = attacker.enforcer.rehearsed
                shared = truth, running, state, asked, rehearsal
                scores, action = probe.driven(shown.observation, *shared, numbers)
            else:
                scores, action = subject.driven(shown.observation, state, numbers)
            executed = attacker.execute(action)
            if shown.orders is not None:
                td["orders"] = shown.orders
            if otherwise:
                deeds.append(executed, shown.orders)
            td = env.step(td.set("action", executed))["next"]
            meter.step(truth, shown, unattacked, action, running, state, td)
            meter.forged(shown.used, executed, action, running)
            if trace is not None and clean is not None:
                trace.append(_traced(truth, shown, scores, clean, action, executed, running, td))
            state = subject.advance(shown.observation, action, state)
            if bool(td["done"].all()):
                break
        probe.end()
    if several and (victims_draws.used() or attacks_draws.used()):
        raise NotJointError
    measured = meter.columns()
    judged = unknown(len(seeds))
    if judge is not None and otherwise:
        judged |= judge(deeds, measured["steps"].astype(np.int64), measured["crashed"].astype(np.bool_))
    reach = threat.reach(td["observation"].shape[-2], facts.features, facts.max_steps)
    shift = np.full(len(seeds), reach / policy.noise if policy.noise else np.nan)
    return {"seed": episodes.numpy(), **measured, **judged, **probe.columns(), "shift": shift}


def _view(attack: DrivingAttack | None, td: TensorDictBase) -> View | None:
    """The traffic, for an attack that drives some of it."""
    return View.parsed(td["traffic"]) if attack is not None and attack.drives else None


def _check_actions(subject: CountedPolicy, observation: Tensor, state: State, facts: DrivingFacts) -> None:
    scores = subject.aside(observation, state)
    if subject.action_type == "discrete" and facts.actions:
        count = scores.shape[-1]
        if count != len(facts.actions):
            raise UserError(
                f"the victim has {count} actions, the world has {len(facts.actions)}: {', '.join(facts.actions)}"
            )


def _check_rows(subject: CountedPolicy, observation: Tensor, state: State, gradients: bool) -> None:
    """Raise NotJointError if an answer, or its gradient, depends to the last bit on the size of the batch or the place in it.

    So must the value of a continuous victim's critic, if it has one.
    """

    def answers(rows: Tensor) -> list[Tensor]:
        shown, own = observation[rows], rows_of(state, rows)
        scores = subject.aside(shown, own, rows)
        if not gradients:
            return [scores]
        found = [scores, _slope(subject, shown, own, rows)]
        if subject.action_type == "continuous":
            with suppress(NotImplementedError), subject.unseen():
                value, slope = subject.valued(shown, scores, own, rows)
                found += [value] if slope is None else [value, slope]
        return found

    order = torch.arange(len(observation))
    whole = answers(order)
    for size in range(1, min(LARGEST, len(order))):
        if subject.shares or not all(map(torch.equal, answers(order[-size:]), (one[-size:] for one in whole))):
            raise NotJointError


def _slope(subject: CountedPolicy, observation: Tensor, state: State, numbers: Tensor) -> Tensor:
    """[B, V, F] the gradient of the summed scores."""
    with subject.unseen():
        return subject.differentiated(observation, state, lambda scores: scores.sum(-1), numbers)[1]


def _traced(
    truth: Tensor,
    shown: Shown,
    scores: Tensor,
    clean: Tensor,
    action: Tensor,
    executed: Tensor,
    running: Tensor,
    after: TensorDictBase,
) -> dict[str, Tensor]:
    """The values of one step that a recording needs."""
    names = ("progress", "speed", "x", "ttc", "crashed", "offroad")
    used = shown.used
    forged = {}
    if used is not None:
        forged = {"hidden": used.hidden, "invented": used.invented, "age": used.age, "false_messages": used.messages}
    return {
        "observation": truth,
        "perturbed": shown.observation,
        "scores": scores,
        "clean_scores": clean,
        "action": action,
        "executed": executed,
        **forged,
        "queries": shown.queries,
        "running": running,
        "reward": after["reward"].squeeze(-1),
        **{name: after["info", name].squeeze(-1) for name in names},
    }
