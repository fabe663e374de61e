"""The attack and the victim as TensorDict modules: any TorchRL rollout or collector runs them."""

from __future__ import annotations

import time

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from bench.driving.contracts import DrivingAttack, Features, Policy
from bench.driving.threat import ObservationThreat, Oracle
from bench.errors import UserError


class AttackModule(TensorDictModuleBase):
    """Reads `observation` [B, V, F], writes what the victim is shown to `perturbed`, projected onto the perturbation set.

    Also writes, for each episode of the batch: `queries` int64 [B] spent in the step, `excess` float [B] (how far outside the
    set the attack's own answer was, L-inf on the normalised scale), `gradients` and `zero_gradients` int64 [B] (gradients taken
    in the step, and those that were 0), and keeps `milliseconds`, the attack's own wall time of
    the last call. Episodes whose `done` is set are neither attacked nor counted.

    Args:
        attack: the attack.
        policy: the victim, reached by the attack through an oracle only.
        threat: the threat model, enforced here.
        features: of the observation.
        seed: of the attack's random generator.
    """

    def __init__(
        self, attack: DrivingAttack, policy: Policy, threat: ObservationThreat, features: Features, *, seed: int
    ) -> None:
        super().__init__()
        self.in_keys = ["observation"]
        self.out_keys = ["perturbed", "queries", "excess", "gradients", "zero_gradients"]
        self.attack = attack
        generator = torch.Generator().manual_seed(seed)
        self.oracle = Oracle(policy, threat, attack.access, features, generator)
        self.milliseconds = 0.0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation = tensordict.get("observation")
        done = tensordict.get("done", None)
        perturbed = observation.clone()
        queries, gradients, zero_gradients = torch.zeros(3, observation.shape[0], dtype=torch.int64)
        excess = torch.zeros(observation.shape[0])
        rows = torch.arange(observation.shape[0]) if done is None else (~done.reshape(-1)).nonzero().squeeze(-1)
        if rows.numel():
            shown, spent, outside = self._attack(observation[rows])
            perturbed[rows], queries[rows], excess[rows] = shown, spent, outside
            gradients[rows], zero_gradients[rows] = self.oracle.gradients, self.oracle.zero_gradients
        counts = {"queries": queries, "gradients": gradients, "zero_gradients": zero_gradients}
        return tensordict.update({"perturbed": perturbed, "excess": excess} | counts)

    def _attack(self, observation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        start = time.perf_counter()
        self.oracle.begin_step(observation)
        answer = self.attack.perturb(observation, self.oracle)
        if not isinstance(answer, Tensor) or answer.shape != observation.shape:
            found = f"shape {tuple(answer.shape)}" if isinstance(answer, Tensor) else f"a {type(answer).__name__}"
            raise UserError(f"{type(self.attack).__name__}.perturb returned {found}, not {tuple(observation.shape)}")
        answer = answer.detach()
        shown = self.oracle.project(answer)
        self.milliseconds = (time.perf_counter() - start) * 1000
        excess = (answer - shown).abs().flatten(1).amax(1)
        if not bool(excess.isfinite().all()):
            raise UserError(f"{type(self.attack).__name__}.perturb returned numbers that are NaN or infinite")
        return shown, self.oracle.spent, excess


class PolicyModule(TensorDictModuleBase):
    """Reads an observation, writes the victim's `action`."""

    def __init__(self, policy: Policy, in_key: str = "observation") -> None:
        super().__init__()
        self.in_keys = [in_key]
        self.out_keys = ["action"]
        self.policy = policy

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        with torch.no_grad():
            return tensordict.set("action", self.policy.decide(tensordict.get(self.in_keys[0])))
