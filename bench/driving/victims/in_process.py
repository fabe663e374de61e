"""A driver that is an object of Python: a `Policy`, a network of torch or TorchRL, or a model of Stable-Baselines3."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from cavbench.driving import ActionType, DrivingFacts, DrivingVictim, Policy
from cavbench.driving.victims.from_file import FilePolicy, Typed, check_trained_in
from cavbench.driving.victims.remembering import RememberingPolicy
from cavbench.driving.victims.sb3_fitting import network_of
from cavbench.driving.victims.sb3_model import LIBRARY, critic_of, is_model, is_sampling_part
from cavbench.driving.victims.spaces import UNKNOWN
from cavbench.driving.victims.torchrl_actor import ActorNetwork, is_actor
from cavbench.errors import UserError, reason
from cavbench.identity.bytecode import code_of
from cavbench.identity.content import content
from cavbench.identity.fingerprint import digest, state_digest

SAME = 1e-5
"""Largest difference of two answers that count as equal."""


@dataclass(frozen=True, kw_only=True)
class InProcess(DrivingVictim):
    """A policy that was given as an object. Its records cannot be replayed: no package ships it.

    Args:
        source: class of the object.
        actions: its type of actions.
        trained_in: the world of its training, as tables print it; `unknown` if neither the object nor the user says it.
    """

    source: str
    actions: ActionType
    trained_in: str = UNKNOWN

    policies: ClassVar[tuple[Policy, ...]] = ()
    """One for each training seed; set by `in_process`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_trained_in(self.trained_in)

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
        """A copy of the policy of a training seed, or of the only policy, so that no run can change the user's object.

        Raises:
            UserError: if there are fewer policies.
        """
        # As a policy from a file, one policy is that of any seed: an attack may have several trainings.
        seed = seed if self.seeded else 0
        if seed >= len(self.policies):
            raise UserError(f"there is no policy of training seed {seed}: {len(self.policies)} were given")
        return copy.deepcopy(self.policies[seed])


def in_process(
    objects: Sequence[object],
    facts: DrivingFacts,
    observation: Tensor,
    actions: str | None,
    trained_in: Callable[[], str] = lambda: UNKNOWN,
) -> InProcess:
    """The victim of one object, or of several trainings of one policy.

    Args:
        objects: one for each training seed.
        facts: facts of the world.
        observation: some observations of the world [B, V, F], to try the networks on.
        actions: type of actions of a torch network; None infers it from the size of its output.
        trained_in: says the world of their training; called once they fit.

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
    victim = InProcess(source=sources.pop(), actions=types.pop(), trained_in=trained_in())
    object.__setattr__(victim, "policies", policies)
    if any(is_model(one) for one in objects):
        object.__setattr__(victim, "libraries", (LIBRARY,))
    return victim


def code_of_policies(victim: InProcess) -> str:
    """Hash of the code of its networks, and of all that they hold: weights, lists, networks in attributes."""
    parts = [part for policy in victim.policies for part in policy.modules()]
    return digest([code_of(*parts), [content(vars(policy)) for policy in victim.policies]])


def _policy(given: object, facts: DrivingFacts, observation: Tensor, actions: str | None) -> Policy:
    if isinstance(given, Policy):
        policy = copy.deepcopy(given).requires_grad_(False).eval()
    elif is_model(given):
        policy = _of_model(given, facts, observation)
    elif is_sampling_part(given):
        raise UserError(f"{type(given).__name__} is a part of a model of Stable-Baselines3: give the model itself")
    elif isinstance(given, nn.Module):
        policy = _of_module(given, facts, observation, actions)
    else:
        hint = ""
        if hasattr(given, "step") and hasattr(given, "reset"):
            hint = ". An environment is no policy; as a world it is a subclass of cavbench.gym.GymWorld"
        raise UserError(
            f"a victim is a name, a cavbench.driving.Policy, a torch.nn.Module or a model of Stable-Baselines3, "
            f"got {type(given).__name__}{hint}"
        )
    policy.weights_sha256 = policy.weights_sha256 or state_digest(policy)
    try:
        with torch.no_grad():
            scores = policy.scores(observation, policy.initial(torch.arange(len(observation))))
    # The user's code may raise anything.
    except Exception as error:
        shape = list(observation.shape)
        raise UserError(f"{type(given).__name__} fails on observations {shape}: {reason(error)}") from error
    _check_scores(type(given).__name__, policy, scores, observation, facts)
    return policy


def _check_scores(name: str, policy: Policy, scores: object, observation: Tensor, facts: DrivingFacts) -> None:
    """Refuse a policy whose scores are not those of the world's actions."""
    size = len(facts.actions) if policy.action_type == "discrete" else len(facts.controls)
    wanted = [len(observation), size]
    found = list(scores.shape) if isinstance(scores, Tensor) else type(scores).__name__
    if found != wanted:
        raise UserError(
            f"{name} returns {found} for {len(observation)} observations, {policy.action_type} actions need {wanted}"
        )


def _of_model(model: object, facts: DrivingFacts, observation: Tensor) -> Policy:
    network, own, shape, native = network_of(model, facts, observation)
    options: dict[str, Any] = {
        "shape": shape,
        "action_type": own.action_type,
        "width": own.width,
        "sha256": state_digest(network),
        "native": native,
    }
    if network.memory:
        return RememberingPolicy(network, network.memory, **options)
    return FilePolicy(network, critic=critic_of(own), **options)


def _of_module(module: nn.Module, facts: DrivingFacts, observation: Tensor, actions: str | None) -> Policy:
    """The policy of a network that takes observations [N, V, F], flattened or not, or flat ones in a flat world."""
    name = type(module).__name__
    native = facts.native(observation)
    network, shape, answer = _fitting(name, module, native)
    if isinstance(network, ActorNetwork):
        network.check(native.reshape(-1, *shape))
    options: dict[str, Any] = {
        "shape": shape,
        "action_type": _action_type(name, answer.shape[1], facts, actions),
        "width": answer.shape[1],
        "sha256": state_digest(network),
        "native": facts.native if facts.flat else None,
    }
    if isinstance(network, ActorNetwork) and network.memory:
        return RememberingPolicy(network, network.memory, **options)
    return FilePolicy(network, **options)


def _fitting(name: str, module: nn.Module, native: Tensor) -> tuple[nn.Module, tuple[int, ...], Tensor]:
    """A copy of a network, the shape of the observations that it takes, and its answer to some.

    Raises:
        UserError: if it takes none, or two shapes that it answers differently.
    """
    network = _copied(name, module)
    others = {weight.dtype for weight in network.parameters() if weight.is_floating_point()} - {torch.float32}
    # The weights of another precision compute in float32, as the world does, unless the network itself asks for their own.
    networks = [copy.deepcopy(network).float(), network] if others else [network]
    networks += [Typed(network, others.pop())] if len(others) == 1 and not is_actor(module) else []
    first, flat = tuple(native.shape[1:]), (native[0].numel(),)
    complaints: list[str] = []
    for one in networks:
        found = {shape: _answer(one, native.reshape(-1, *shape)) for shape in dict.fromkeys([first, flat])}
        answers = {shape: answer for shape, answer in found.items() if isinstance(answer, Tensor)}
        complaints = complaints or [f"on {[len(native), *shape]} {found[shape]}" for shape in found]
        if answers:
            shape, answer = next(iter(answers.items()))
            break
    else:
        wanted = f"{[len(native), *first]} or {[len(native), *flat]}"
        raise UserError(
            f"{name} must map observations {wanted} to scores or actions [{len(native)}, A]: {'; '.join(complaints)}"
        )
    if any(other.shape != answer.shape or not torch.allclose(other, answer, atol=SAME) for other in answers.values()):
        raise UserError(
            f"{name} answers observations {list(first)} and flattened ones {list(flat)} differently; say which it takes: "
            f"nn.Sequential(nn.Flatten(), network), or nn.Sequential(nn.Unflatten(1, {first}), network)"
        )
    return one, shape, answer


def _copied(name: str, module: nn.Module) -> nn.Module:
    """A copy of a network in eval mode, so that no run can change the user's object.

    Raises:
        UserError: if torch cannot copy it.
    """
    try:
        return (ActorNetwork(module) if is_actor(module) else copy.deepcopy(module)).cpu().eval()
    except UserError:
        raise
    # The network may raise anything; torch copies no tensor that has a graph.
    except Exception as error:
        raise UserError(
            f"{name} cannot be copied ({reason(error)}); if it keeps results of its last call, a distribution, call it under "
            "torch.no_grad() once, or give a torch.nn.Module without them"
        ) from error


def _answer(network: nn.Module, observation: Tensor) -> Tensor | str:
    """The answer of a network, one row for each observation; or why it has none."""
    try:
        with torch.no_grad():
            answer = network(observation)
    # The network may raise anything on a shape that it does not take.
    except Exception as error:
        return f"it fails ({reason(error)})"
    if not isinstance(answer, Tensor):
        return f"it returns a {type(answer).__name__}"
    if answer.ndim != 2 or len(answer) != len(observation) or not answer.is_floating_point():
        return f"it returns {list(answer.shape)} of {str(answer.dtype).removeprefix('torch.')}"
    return answer


def _action_type(name: str, width: int, facts: DrivingFacts, actions: str | None) -> ActionType:
    fitting: dict[str, int] = {"discrete": len(facts.actions), "continuous": len(facts.controls)}
    kinds = [kind for kind, size in fitting.items() if size == width and actions in (None, kind)]
    if len(kinds) != 1:
        needs = facts.takes()
        asks = "say which: actions='discrete' or actions='continuous'" if kinds else f"the world needs {needs}"
        raise UserError(f"{name} returns {width} numbers for an observation; {asks}")
    return "discrete" if kinds[0] == "discrete" else "continuous"
