"""Drive one batch of episodes with a victim under attack, and return one row of measurements per episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from bench.driving.attacker import Attacker, Shown
from bench.driving.contracts import DrivingAttack
from bench.driving.dynamics import Dynamics
from bench.driving.features import DrivingFacts
from bench.driving.meter import Columns, Meter
from bench.driving.policy import Policy, State
from bench.driving.probes import EVERY, Probe
from bench.driving.threat import ObservationThreat
from bench.errors import UserError


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
    attack_seed: int,
    dynamics: Dynamics | None = None,
    trace: Trace | None = None,
) -> Columns:
    """Drive every episode of `env` once, to its end, and measure it.

    Args:
        env: a batched environment of a `DrivingWorld`, one episode a seed.
        policy: the (defended) victim.
        attack: the attack on the observations; None for no attack.
        threat: threat model, enforced on the attack.
        seeds: the scenario seed of each episode [B].
        facts: facts of the world.
        attack_seed: seed of the attack's random generator.
        dynamics: the world's rules of motion, for attacks with that access; None if the world does not offer them.
        trace: collects every step of its episodes.

    Returns:
        One column [B] for each measurement; `bench.tracks.driving` has the names and units.

    Raises:
        UserError: if the numbers of actions of the victim and the world differ.
    """
    frames = threat.frames(facts.max_steps)
    attacker = Attacker(attack, policy, threat, facts.features, seed=attack_seed, dynamics=dynamics, frames=frames)
    meter, probe = Meter(len(seeds), policy, facts), Probe(len(seeds), policy)
    episodes = torch.as_tensor(list(seeds), dtype=torch.int64)
    with torch.no_grad():
        td = env.reset(TensorDict({"seed": episodes}, batch_size=env.batch_size))
        state = policy.initial(episodes)
        _check_actions(policy, td["observation"], state, facts)
        for step in range(facts.max_steps):
            truth, running = td["observation"], ~td["done"].squeeze(-1)
            probing = step % EVERY == 0 and probe.look(truth, running, state)
            attacker.oracle.asked = [] if probing else None
            shown = attacker.show(truth, running, state)
            if attacker.oracle.asked:
                probe.count_draws(attacker.oracle.asked, running)
            action = policy.decide(shown.observation, state)
            td = env.step(td.set("action", action))["next"]
            meter.step(truth, shown, action, running, state, td)
            if trace is not None:
                trace.append(_traced(truth, shown, action, running, state, td, policy))
            state = policy.advance(shown.observation, action, state)
            if bool(td["done"].all()):
                break
    return {"seed": episodes.numpy(), **meter.columns(), **probe.columns()}


def _check_actions(policy: Policy, observation: Tensor, state: State, facts: DrivingFacts) -> None:
    if policy.action_type == "discrete" and facts.actions:
        with torch.random.fork_rng(devices=[]):
            count = policy.scores(observation, state).shape[-1]
        if count != len(facts.actions):
            raise UserError(
                f"the victim has {count} actions, the world has {len(facts.actions)}: {', '.join(facts.actions)}"
            )


def _traced(
    truth: Tensor,
    shown: Shown,
    action: Tensor,
    running: Tensor,
    state: State,
    after: TensorDictBase,
    policy: Policy,
) -> dict[str, Tensor]:
    """The values of one step that a recording needs."""
    names = ("progress", "speed", "x", "ttc", "crashed", "offroad")
    return {
        "observation": truth,
        "perturbed": shown.observation,
        "scores": policy.scores(shown.observation, state),
        "clean_scores": policy.scores(truth, state),
        "action": action,
        "queries": shown.queries,
        "running": running,
        "reward": after["reward"].squeeze(-1),
        **{name: after["info", name].squeeze(-1) for name in names},
    }
