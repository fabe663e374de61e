"""A model object of Stable-Baselines3 in a world: its spaces, its wrappers and its last observations are checked first."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from torch import Tensor

from cavbench.driving import DrivingFacts
from cavbench.driving.victims.sb3_model import INSTEAD, ModelNetwork
from cavbench.driving.victims.sb3_seen import Stack, Stacked
from cavbench.driving.victims.sb3_traces import check_traces
from cavbench.driving.victims.spaces import Bounds, Expected, check_actions, check_range
from cavbench.errors import UserError, short


def network_of(
    model: Any, facts: DrivingFacts, observation: Tensor
) -> tuple[ModelNetwork | Stacked, ModelNetwork, tuple[int, ...], Callable[[Tensor], Tensor] | None]:
    """The network of a model that fits a world, and what converts the world's observations for it (`Expected.fit`).

    Args:
        model: the model.
        facts: facts of the world.
        observation: observations of the world [B, V, F].

    Returns:
        The network that is driven, the model's own network in it, the shape that it is shown, and what converts observations.

    Raises:
        UserError: if its spaces are not the world's, its environment has changed the observations in a way that is not known,
            or it acts otherwise than `predict(deterministic=True)`.
    """
    network = ModelNetwork(model)
    name = f"the {network.algorithm} model"
    check_actions(name, network.action_type, network.width, facts)
    if network.range is not None:
        check_range(name, network.range, facts)
    expected = Expected(facts=facts, rows=observation.shape[-2])
    stack = _stack(model, name)
    try:
        bounds = network.bounds if stack is None else stack.bounds(network.bounds)
    except ValueError:
        raise UserError(
            f"{name} takes {network.bounds}, which is no stack of {stack and stack.frames} equal frames"
        ) from None
    native = expected.fit(name, bounds.shape, bounds)
    if network.normaliser is None and network.of_frame is None:
        last, raw = (_kept(model, key, network.bounds) for key in ("_last_obs", "_last_original_obs"))
        if stack is not None:
            last, raw = (None if one is None else stack.frame(one, network.shape) for one in (last, raw))
        # A model that still has both is as it was trained; `load(env=...)` and `set_env` drop the last observation.
        live = model.get_env() is not None and last is not None
        normaliser = model.get_vec_normalize_env()
        behind = normaliser is None and not live and getattr(model, "_last_original_obs", None) is not None
        check_traces(name, expected, last, raw, behind, native=native is not None, algorithm=network.algorithm)
    shown = observation if native is None else native(observation)
    shown = shown.reshape(-1, *bounds.shape)
    if stack is None:
        if network.of_frame is not None:
            raise UserError(f"{name} has statistics of {network.of_frame.shape} and observations of {network.shape}")
        network.check(shown)
        return network, network, network.shape, native
    if network.memory:
        raise UserError(f"{name} is recurrent and takes a stack of frames; only one of the two is read. {INSTEAD}")
    network.check(stack.together(shown.unsqueeze(1).expand(-1, stack.frames, *bounds.shape)))
    return Stacked(network, stack, bounds.shape, network.of_frame), network, bounds.shape, native


def _stack(model: Any, name: str) -> Stack | None:
    """The stack of frames that the environment of a model makes; None if it makes none.

    Raises:
        UserError: if there are several.
    """
    env, found = model.get_env(), []
    while env is not None:
        kind = type(env).__name__
        if kind == "VecFrameStack":
            frames = env.stacked_obs
            layout: Any = "first" if frames.channels_first else "last"
            found.append(Stack(frames=int(frames.n_stack), layout=layout, zero=True))
        elif kind == "FrameStackObservation":
            padding = env.padding_type
            if padding not in ("reset", "zero"):
                raise UserError(
                    f"{name} has a FrameStackObservation with padding {short(str(padding))}; reset and zero are read"
                )
            found.append(Stack(frames=int(env.stack_size), layout="new", zero=padding == "zero"))
        inner = getattr(env, "envs", None)
        env = getattr(env, "venv", None) or (inner[0] if inner else getattr(env, "env", None))
    if len(found) > 1:
        raise UserError(f"{name} has {len(found)} stacks of frames around its environment; one is read. {INSTEAD}")
    return found[0] if found else None


def _kept(model: Any, name: str, bounds: Bounds) -> Any:
    """The last observations of a model's training [n, V * F]; None if it keeps none."""
    kept = getattr(model, name, None)
    if isinstance(kept, dict):
        kept = np.concatenate([np.reshape(part, (len(part), -1)) for _, part in sorted(kept.items())], -1)
    size = int(np.prod(bounds.shape))
    return kept.reshape(-1, size) if isinstance(kept, np.ndarray) and kept.size and kept.size % size == 0 else None
