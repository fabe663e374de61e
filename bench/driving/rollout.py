"""One batch of episodes: a victim drives, an attack looks on, and every episode leaves one row of measurements."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from bench.driving.contracts import DrivingAttack, Features, Policy
from bench.driving.pipeline import AttackModule, PolicyModule
from bench.driving.probes import EVERY, Probe
from bench.driving.threat import ObservationThreat

CHANGED = 0.1
"""A continuous action counts as changed when it is off by more than this on its [-1, 1] scale."""

Columns = dict[str, NDArray[np.generic]]


@dataclass
class Trace:
    """Every step of a few episodes of the batch, for recordings: `steps[name][t]` is an array [len(episodes), ...]."""

    episodes: Sequence[int]
    steps: dict[str, list[NDArray[np.generic]]] = field(default_factory=dict)

    def append(self, values: Mapping[str, Tensor]) -> None:
        """Take one step: tensors [B, ...] of the whole batch."""
        for name, value in values.items():
            self.steps.setdefault(name, []).append(value[list(self.episodes)].detach().numpy().copy())


def rollout(
    env: EnvBase,
    policy: Policy,
    attack: DrivingAttack,
    threat: ObservationThreat,
    seeds: Sequence[int],
    *,
    features: Features,
    max_steps: int,
    attack_seed: int,
    trace: Trace | None = None,
) -> Columns:
    """Drive every episode of `env` once, to its end, and measure it.

    Args:
        env: a batched environment of a `World`, one episode a seed.
        policy: the (defended) victim.
        attack: what stands between the world and the victim.
        threat: enforced on the attack.
        seeds: the scenario seed of each episode [B].
        features: of the observation.
        max_steps: what `safe_progress` is a mean over, whatever the episode's length.
        attack_seed: of the attack's random generator.
        trace: filled with every step of its episodes.

    Returns:
        A column [B] a measurement; the names and units are those of `bench.records.store.SCHEMA`.
    """
    attacker = AttackModule(attack, policy, threat, features, seed=attack_seed)
    pipeline = PolicyModule(policy, in_key="perturbed")
    meter, probe = _Meter(len(seeds), policy, features), Probe(len(seeds), policy)
    seed_tensor = torch.as_tensor(list(seeds), dtype=torch.int64)
    policy.reset(seed_tensor)
    with torch.no_grad():
        td = env.reset(TensorDict({"seed": seed_tensor}, batch_size=env.batch_size))
        for step in range(max_steps):
            running = ~td["done"].squeeze(-1)
            probing = step % EVERY == 0
            attacker.oracle.asked = [] if probing and probe.look(td["observation"], running) else None
            pipeline(attacker(td))
            if attacker.oracle.asked:
                probe.count_draws(attacker.oracle.asked, running)
            before, td = td, env.step(td)["next"]
            meter.step(before, td, attacker.milliseconds)
            if trace is not None:
                trace.append(_traced(before, td, policy))
            if bool(td["done"].all()):
                break
    return {"seed": seed_tensor.numpy(), **meter.columns(max_steps), **probe.columns()}


def _traced(before: TensorDictBase, after: TensorDictBase, policy: Policy) -> dict[str, Tensor]:
    """What a recording shows of one step."""
    names = ("progress", "speed", "x", "ttc", "crashed", "offroad")
    return {
        "observation": before["observation"],
        "perturbed": before["perturbed"],
        "scores": policy.scores(before["perturbed"]),
        "clean_scores": policy.scores(before["observation"]),
        "action": before["action"],
        "queries": before["queries"],
        "running": ~before["done"].squeeze(-1),
        "reward": after["reward"].squeeze(-1),
        **{name: after["info", name].squeeze(-1) for name in names},
    }


class _Meter:
    """Running sums of a batch of episodes; an episode counts until it is done.

    In NumPy: a step is some forty operations on [B] numbers, and what each costs is its call.
    """

    SUMS = ("steps", "return", "progress", "mean_speed", "changed", "linf", "l2", "linf_m", "linf_mps", "attack_ms")

    def __init__(self, batch: int, policy: Policy, features: Features) -> None:
        self.policy = policy
        self.half_range = features.half_range().numpy()
        self.positions = np.array([unit == "m" for unit in features.units])
        self.sums = np.zeros((len(self.SUMS), batch))
        self.linf_max, self.excess_max = np.zeros(batch, np.float32), np.zeros(batch, np.float32)
        self.min_ttc = np.full(batch, np.inf, np.float32)
        self.crashed, self.offroad = np.zeros(batch, np.bool_), np.zeros(batch, np.bool_)
        self.start_x, self.end_x = np.full(batch, np.nan, np.float32), np.zeros(batch, np.float32)
        self.gradients, self.zero_gradients = np.zeros(batch), np.zeros(batch)
        self.queries: list[NDArray[np.int64]] = []
        self.actions: list[NDArray[np.int64]] = []

    def step(self, before: TensorDictBase, after: TensorDictBase, milliseconds: float) -> None:
        """Count one step of the episodes that were running before it."""
        running = ~before["done"].squeeze(-1).numpy()
        info = {name: value.squeeze(-1).numpy() for name, value in after["info"].items()}
        offset = (before["perturbed"] - before["observation"]).abs().numpy()[..., 1:]
        physical = offset * self.half_range
        linf = offset.max((1, 2))
        measured = (
            np.ones(len(running)),
            after["reward"].squeeze(-1).numpy(),
            info["progress"],
            info["speed"],
            self._changed(before, running & (linf > 0)),
            linf,
            np.sqrt(np.square(offset).sum((1, 2))),
            physical[..., self.positions].max((1, 2), initial=0.0),
            physical[..., ~self.positions].max((1, 2), initial=0.0),
            np.full(len(running), milliseconds / max(running.sum(), 1)),
        )
        self.sums += np.where(running, np.stack(measured), 0.0)
        np.maximum(self.linf_max, linf, out=self.linf_max, where=running)
        np.maximum(self.excess_max, before["excess"].numpy(), out=self.excess_max)
        np.minimum(self.min_ttc, info["ttc"], out=self.min_ttc, where=running)
        self.crashed |= info["crashed"] & running
        self.offroad |= info["offroad"] & running
        np.copyto(self.start_x, info["x"], where=np.isnan(self.start_x))
        np.copyto(self.end_x, info["x"], where=running)
        self.gradients += before["gradients"].numpy()
        self.zero_gradients += before["zero_gradients"].numpy()
        self.queries.append(np.where(running, before["queries"].numpy(), -1))
        if self.policy.action_type == "discrete":
            self.actions.append(np.where(running, before["action"].numpy(), -1))

    def _changed(self, before: TensorDictBase, touched: NDArray[np.bool_]) -> NDArray[np.float64]:
        """[B] 1 where the attack changed the victim's decision; it can have only where the observation is `touched` [B]."""
        changed = np.zeros(len(touched))
        if touched.any():
            rows = torch.from_numpy(touched)
            action, clean = before["action"][rows], self.policy.choose(self.policy.scores(before["observation"][rows]))
            if self.policy.action_type == "discrete":
                changed[touched] = (clean != action).numpy()
            else:
                changed[touched] = ((clean - action).abs().amax(-1) > CHANGED).numpy()
        return changed

    def columns(self, max_steps: int) -> Columns:
        """The measurements of each episode."""
        sums = dict(zip(self.SUMS, self.sums, strict=True))
        steps = np.maximum(sums["steps"], 1)
        failed = self.crashed | self.offroad
        queries = np.stack(self.queries).astype(np.float64)
        queries[queries < 0] = np.nan
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # An episode that was never driven has no queries.
            mean, median = np.nanmean(queries, 0), np.nanquantile(queries, 0.5, 0, method="lower")
        return {
            "steps": sums["steps"].astype(np.int32),
            "return": sums["return"],
            "safe_progress": np.where(failed, 0.0, sums["progress"] / max_steps),
            "crashed": self.crashed,
            "offroad": self.offroad,
            "distance_m": (self.end_x - self.start_x).astype(np.float64),
            "min_ttc_s": self.min_ttc.astype(np.float64),
            "queries": mean,
            "queries_median": median,
            "queries_max": np.nan_to_num(queries).max(0),
            "linf_max": self.linf_max.astype(np.float64),
            "excess_max": self.excess_max.astype(np.float64),
            **{name: sums[name] / steps for name in self.SUMS[3:]},
            "action_counts": self._action_counts(),
            "gradient_queries": self.gradients / steps,
            "zero_gradients": np.where(self.gradients > 0, self.zero_gradients / np.maximum(self.gradients, 1), np.nan),
        }

    def _action_counts(self) -> NDArray[np.generic]:
        """[B, A] how often each discrete action was taken; [B, 0] for continuous ones."""
        if not self.actions:
            return np.zeros((len(self.crashed), 0), np.int32)
        actions = np.stack(self.actions, 1)
        count = max(int(actions.max()) + 1, 5)
        return np.stack([(actions == a).sum(1) for a in range(count)], 1).astype(np.int32)
