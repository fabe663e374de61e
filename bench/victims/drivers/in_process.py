"""A driver that is an object of Python: a `Policy`, a torch network or a model of Stable-Baselines3."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from bench.driving import ActionType, DrivingFacts, DrivingVictim, Policy
from bench.errors import UserError, reason
from bench.plugins.bytecode import code_of, plain_attributes
from bench.plugins.fingerprint import digest, state_digest
from bench.victims.drivers.from_file import CONTROLS, FilePolicy
from bench.victims.drivers.sb3_model import LIBRARY, ModelNetwork, critic_of, is_model


@dataclass(frozen=True, kw_only=True)
class InProcess(DrivingVictim):
    """A policy that was given as an object. Its records cannot be replayed: no package ships it.

    Args:
        source: class of the object.
        actions: its type of actions.
    """

    source: str
    actions: ActionType

    policies: ClassVar[tuple[Policy, ...]] = ()
    """One for each training seed; set by `in_process`."""

    @property
    def action_type(self) -> ActionType:
        return self.actions

    @property
    def draws(self) -> bool:
        return not all(isinstance(policy, FilePolicy) for policy in self.policies)

    @property
    def seeded(self) -> bool:
        return len(self.policies) > 1

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        """A copy of the policy of a training seed, so that no run can change the user's object.

        Raises:
            UserError: if there are fewer policies.
        """
        if seed >= len(self.policies):
            raise UserError(f"there is no policy of training seed {seed}: {len(self.policies)} were given")
        return copy.deepcopy(self.policies[seed])


def in_process(objects: Sequence[object], facts: DrivingFacts, observation: Tensor, actions: str | None) -> InProcess:
    """The victim of one object, or of several trainings of one policy.

    Args:
        objects: one for each training seed.
        facts: facts of the world.
        observation: some observations of the world [B, V, F], to try the networks on.
        actions: type of actions of a torch network; None infers it from the size of its output.

    Raises:
        UserError: if an object is no policy, does not fit the world, or the objects differ in their actions.
    """
    policies = tuple(_policy(one, facts, observation, actions) for one in objects)
    types = {policy.action_type for policy in policies}
    sources = {f"{type(one).__module__}.{type(one).__qualname__}" for one in objects}
    if len(types) > 1 or len(sources) > 1:
        raise UserError(
            f"a list of victims holds the trainings of one policy, got {', '.join(sorted(sources))} with "
            f"{' and '.join(sorted(types))} actions; score them one by one"
        )
    victim = InProcess(source=sources.pop(), actions=types.pop())
    object.__setattr__(victim, "policies", policies)
    if any(is_model(one) for one in objects):
        object.__setattr__(victim, "libraries", (LIBRARY,))
    return victim


def code_of_policies(victim: InProcess) -> str:
    """Hash of the code and the structure of its networks; the hash of the weights is apart."""
    parts = [part for policy in victim.policies for part in policy.modules()]
    return digest([code_of(*parts), [plain_attributes(policy) for policy in victim.policies]])


def _policy(given: object, facts: DrivingFacts, observation: Tensor, actions: str | None) -> Policy:
    if isinstance(given, Policy):
        policy = copy.deepcopy(given).requires_grad_(False).eval()
    elif is_model(given):
        policy = _of_model(given, facts)
    elif isinstance(given, nn.Module):
        policy = _of_module(given, facts, observation, actions)
    else:
        raise UserError(
            f"a victim is a name, a bench.driving.Policy, a torch.nn.Module or a model of Stable-Baselines3, "
            f"got {type(given).__name__}"
        )
    policy.weights_sha256 = policy.weights_sha256 or state_digest(policy)
    try:
        with torch.no_grad():
            policy.scores(observation, policy.initial(torch.arange(len(observation))))
    # The user's code may raise anything.
    except Exception as error:
        shape = list(observation.shape)
        raise UserError(f"{type(given).__name__} fails on observations {shape}: {reason(error)}") from error
    return policy


def _of_model(model: object, facts: DrivingFacts) -> Policy:
    network = ModelNetwork(model)
    wanted = len(facts.actions) if network.action_type == "discrete" else CONTROLS
    if network.width != wanted:
        raise UserError(
            f"the model has {network.width} {network.action_type} actions, the world needs {wanted}"
            + (f": {', '.join(facts.actions)}" if network.action_type == "discrete" else "")
        )
    native = facts.native if facts.flat else None
    return FilePolicy(
        network, network.shape, network.action_type, wanted, state_digest(network), critic_of(network), native
    )


def _of_module(module: nn.Module, facts: DrivingFacts, observation: Tensor, actions: str | None) -> Policy:
    """The policy of a network that takes observations [N, V, F], flattened or not, or flat ones in a flat world."""
    network = copy.deepcopy(module).cpu().eval()
    native = facts.native(observation)
    outputs, complaint = {}, ""
    for shape in dict.fromkeys([tuple(native.shape[1:]), (native[0].numel(),)]):
        try:
            with torch.no_grad():
                output = network(native.reshape(-1, *shape))
        # The network may raise anything on a shape that it does not take.
        except Exception as error:
            complaint = reason(error)
            continue
        if isinstance(output, Tensor) and output.ndim == 2 and len(output) == len(native):
            outputs[shape] = output.shape[1]
        else:
            complaint = f"it returns {list(output.shape) if isinstance(output, Tensor) else type(output).__name__}"
    if not outputs:
        wanted = f"{[len(native), *native.shape[1:]]} or {[len(native), native[0].numel()]}"
        raise UserError(
            f"{type(module).__name__} must map observations {wanted} to scores or actions [{len(native)}, A]: {complaint}"
        )
    shape, width = next(iter(outputs.items()))
    kind = _action_type(type(module).__name__, width, facts, actions)
    return FilePolicy(
        network, shape, kind, width, state_digest(network), None, native=facts.native if facts.flat else None
    )


def _action_type(name: str, width: int, facts: DrivingFacts, actions: str | None) -> ActionType:
    fitting: dict[str, int] = {"discrete": len(facts.actions), "continuous": CONTROLS}
    kinds = [kind for kind, size in fitting.items() if size == width and actions in (None, kind)]
    if len(kinds) != 1:
        needs = f"{len(facts.actions)} values of discrete actions ({', '.join(facts.actions)}) or {CONTROLS} controls"
        asks = "say which: actions='discrete' or actions='continuous'" if kinds else f"the world needs {needs}"
        raise UserError(f"{name} returns {width} numbers for an observation; {asks}")
    return "discrete" if kinds[0] == "discrete" else "continuous"
