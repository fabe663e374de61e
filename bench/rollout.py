"""One batch of episodes: a victim drives, an attack looks on, and every episode leaves one row of measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from bench.contracts import Attack, Features, Policy
from bench.pipeline import AttackModule, PolicyModule
from bench.threat import ThreatModel

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
    attack: Attack,
    threat: ThreatModel,
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
        A column [B] a measurement; the names and units are those of `bench.results.SCHEMA`.
    """
    attacker = AttackModule(attack, policy, threat, features, seed=attack_seed)
    pipeline = PolicyModule(policy, in_key="perturbed")
    meter = _Meter(len(seeds), policy, features)
    seed_tensor = torch.as_tensor(list(seeds), dtype=torch.int64)
    policy.reset(seed_tensor)
    with torch.no_grad():
        td = env.reset(TensorDict({"seed": seed_tensor}, batch_size=env.batch_size))
        for _ in range(max_steps):
            pipeline(attacker(td))
            before, td = td, env.step(td)["next"]
            meter.step(before, td, attacker.milliseconds)
            if trace is not None:
                trace.append(_traced(before, td, policy))
            if bool(td["done"].all()):
                break
    return {"seed": seed_tensor.numpy(), **meter.columns(max_steps)}


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
    """Running sums of a batch of episodes; an episode counts until it is done."""

    def __init__(self, batch: int, policy: Policy, features: Features) -> None:
        self.policy = policy
        self.half_range = features.half_range()
        self.positions = torch.tensor([unit == "m" for unit in features.units])
        names = ("steps", "return", "progress", "speed", "changed", "linf", "l2", "linf_m", "linf_mps", "attack_ms")
        self.sums = {name: torch.zeros(batch, dtype=torch.float64) for name in names}
        self.largest = {name: torch.zeros(batch) for name in ("linf_max", "excess_max")}
        self.min_ttc = torch.full((batch,), torch.inf)
        self.crashed = torch.zeros(batch, dtype=torch.bool)
        self.offroad = torch.zeros(batch, dtype=torch.bool)
        self.start_x = torch.full((batch,), torch.nan)
        self.end_x = torch.zeros(batch)
        self.queries: list[Tensor] = []
        self.actions: list[Tensor] = []

    def step(self, before: TensorDictBase, after: TensorDictBase, milliseconds: float) -> None:
        """Count one step of the episodes that were running before it."""
        running = ~before["done"].squeeze(-1)
        info = after["info"]
        rows = running.nonzero().squeeze(-1)
        offset = (before["perturbed"] - before["observation"])[rows, :, 1:].abs()
        physical = offset * self.half_range
        self._add("steps", rows, 1.0)
        self._add("return", rows, after["reward"][rows, 0])
        self._add("progress", rows, info["progress"][rows, 0])
        self._add("speed", rows, info["speed"][rows, 0])
        self._add("changed", rows, self._changed(before, rows))
        self._add("linf", rows, offset.flatten(1).amax(1))
        self._add("l2", rows, offset.flatten(1).norm(dim=1))
        self._add("linf_m", rows, physical[..., self.positions].flatten(1).amax(1))
        self._add("linf_mps", rows, physical[..., ~self.positions].flatten(1).amax(1))
        self._add("attack_ms", rows, milliseconds / max(len(rows), 1))
        self.largest["linf_max"][rows] = torch.maximum(self.largest["linf_max"][rows], offset.flatten(1).amax(1))
        self.largest["excess_max"] = torch.maximum(self.largest["excess_max"], before["excess"])
        self.min_ttc[rows] = torch.minimum(self.min_ttc[rows], info["ttc"][rows, 0])
        self.crashed[rows] |= info["crashed"][rows, 0]
        self.offroad[rows] |= info["offroad"][rows, 0]
        first = self.start_x.isnan()
        self.start_x[first] = info["x"][first, 0]
        self.end_x[rows] = info["x"][rows, 0]
        self.queries.append(torch.where(running, before["queries"], -1))
        if self.policy.action_type == "discrete":
            self.actions.append(torch.where(running, before["action"], -1))

    def _add(self, name: str, rows: Tensor, value: Tensor | float) -> None:
        self.sums[name][rows] += value

    def _changed(self, before: TensorDictBase, rows: Tensor) -> Tensor:
        """[rows] 1.0 where the attack changed the victim's decision."""
        shown, action = before["perturbed"][rows], before["action"][rows]
        truth = before["observation"][rows]
        touched = (shown != truth).flatten(1).any(1)
        clean = action.clone()
        if bool(touched.any()):
            clean[touched] = self.policy.choose(self.policy.scores(truth)[touched])
        if self.policy.action_type == "discrete":
            return (clean != action).double()
        return ((clean - action).abs().amax(-1) > CHANGED).double()

    def columns(self, max_steps: int) -> Columns:
        """The measurements of each episode."""
        sums, steps = self.sums, self.sums["steps"].clamp(min=1)
        failed = self.crashed | self.offroad
        queries = torch.stack(self.queries).double()
        queries[queries < 0] = torch.nan
        mean_names = {"speed": "mean_speed", "changed": "changed", "linf": "linf", "l2": "l2"}
        mean_names |= {"linf_m": "linf_m", "linf_mps": "linf_mps", "attack_ms": "attack_ms"}
        columns = {
            "steps": sums["steps"].int(),
            "return": sums["return"],
            "safe_progress": torch.where(failed, 0.0, sums["progress"] / max_steps),
            "crashed": self.crashed,
            "offroad": self.offroad,
            "distance_m": (self.end_x - self.start_x).double(),
            "min_ttc_s": self.min_ttc.double(),
            "queries": queries.nanmean(0),
            "queries_median": queries.nanmedian(0).values,
            "queries_max": queries.nan_to_num(nan=0.0).amax(0),
            **{name: value.double() for name, value in self.largest.items()},
            **{mean_names[name]: value / steps for name, value in sums.items() if name in mean_names},
        }
        arrays: Columns = {name: value.numpy() for name, value in columns.items()}
        arrays["action_counts"] = self._action_counts()
        return arrays

    def _action_counts(self) -> NDArray[np.generic]:
        """[B, A] how often each discrete action was taken; [B, 0] for continuous ones."""
        if not self.actions:
            return np.zeros((len(self.crashed), 0), np.int32)
        actions = torch.stack(self.actions, 1)
        count = int(actions.max()) + 1
        return torch.stack([(actions == a).sum(1) for a in range(max(count, 5))], 1).int().numpy()
