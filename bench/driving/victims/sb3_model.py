"""The network of a Stable-Baselines3 model object, as a map from observations to values or actions.

Nothing is imported from Stable-Baselines3: the object brings its own code.
"""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from cavbench.driving import ActionType, DrivingFacts
from cavbench.driving.victims.sb3_traces import check_traces
from cavbench.driving.victims.spaces import Bounds, Expected, check_actions, check_range
from cavbench.errors import UserError, short

VALUES, DISTRIBUTION, ACTOR = ("DQN",), ("PPO", "A2C"), ("SAC", "TD3", "DDPG")
LIBRARY = "stable-baselines3"
INSTEAD = "Give the torch.nn.Module from observation to values or actions instead"
CLOSE = 1e-4
"""Largest difference between actions and those of the model's own `predict`."""


def is_model(given: object) -> bool:
    """Whether an object is a model of Stable-Baselines3 or sb3-contrib."""
    packages = {base.__module__.partition(".")[0] for base in type(given).__mro__}
    return "stable_baselines3" in packages and hasattr(given, "policy")


def is_sampling_part(given: object) -> bool:
    """Whether an object is a policy or an actor of a model that samples its actions unless it is asked not to."""
    packages = {base.__module__.partition(".")[0] for base in type(given).__mro__}
    parameters = inspect.signature(type(given).forward).parameters if isinstance(given, nn.Module) else {}
    return "stable_baselines3" in packages and "deterministic" in parameters


class ModelNetwork(nn.Module):
    """What a model computes before it chooses: `predict(deterministic=True)` takes the largest value, or the action itself.

    Differentiable in the observation, and any batch size. Observations are normalised as by the model's VecNormalize, if any.

    Args:
        model: a DQN, PPO, A2C, SAC, TD3 or DDPG.

    Raises:
        UserError: if it is another algorithm, or its spaces are not supported.
    """

    low: Tensor
    high: Tensor
    mean: Tensor
    deviation: Tensor

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.algorithm = next((base.__name__ for base in type(model).__mro__ if base.__name__ in _KNOWN), "")
        contrib = type(model).__module__.startswith("sb3_contrib")
        if not self.algorithm or contrib:
            raise UserError(
                f"models of {type(model).__module__.partition('.')[0]}'s {type(model).__name__} are not supported; "
                f"supported: {', '.join(_KNOWN)} of Stable-Baselines3. {INSTEAD}"
            )
        own = "predict" in vars(model) or type(model).predict.__module__.partition(".")[0] != "stable_baselines3"
        if own:
            raise UserError(
                f"{type(model).__name__} has a predict() of its own, by which it would not be driven. {INSTEAD}"
            )
        space, actions = model.observation_space, model.action_space
        if type(space).__name__ != "Box":
            raise UserError(f"the model takes observations of {short(str(space))}; the type must be Box. {INSTEAD}")
        if type(actions).__name__ not in ("Discrete", "Box"):
            raise UserError(
                f"the model takes actions of {short(str(actions))}; the type must be Discrete or Box. {INSTEAD}"
            )
        if int(getattr(actions, "start", 0)):
            raise UserError(f"the model numbers its actions from {actions.start}; they must be numbered from 0")
        self.bounds = Bounds.of(space)
        self.shape = self.bounds.shape
        self.action_type: ActionType = "discrete" if type(actions).__name__ == "Discrete" else "continuous"
        self.range = Bounds.of(actions) if self.action_type == "continuous" else None
        self.width = int(actions.n) if self.range is None else int(np.prod(actions.shape))
        self.policy = _copied(model.policy).cpu()
        self.policy.set_training_mode(False)
        if self.action_type == "continuous":
            self.register_buffer("low", torch.as_tensor(actions.low).flatten())
            self.register_buffer("high", torch.as_tensor(actions.high).flatten())
        self._set_normalisation(model.get_vec_normalize_env())

    def _set_normalisation(self, env: Any) -> None:
        self.clip = 0.0
        if env is None or not env.norm_obs:
            return
        self.clip = float(env.clip_obs)
        # In float64, as there: a feature that hardly varies is divided by almost nothing.
        self.register_buffer("mean", torch.as_tensor(env.obs_rms.mean, dtype=torch.float64))
        spread = torch.as_tensor(env.obs_rms.var, dtype=torch.float64) + env.epsilon
        self.register_buffer("deviation", spread.sqrt())

    def forward(self, observation: Tensor) -> Tensor:
        """Q-values or logits [N, A], or actions [N, 2] in [-1, 1], of observations [N, *shape]."""
        observation = self.normalised(observation)
        if self.algorithm in VALUES:
            return self.policy.q_net(observation)
        # Actors answer in [-1, 1]; `predict` scales that to the range of the actions.
        if self.algorithm == "SAC":
            mean, *_ = self.policy.actor.get_action_dist_params(observation)
            return mean.tanh()
        if self.algorithm in ACTOR:
            return self.policy.actor(observation)
        found = self._distribution(observation)
        if self.action_type == "discrete":
            return found.distribution.logits
        return found.mode() if self.policy.squash_output else self._scaled(found.mode())

    def _distribution(self, observation: Tensor) -> Any:
        """The distribution of the actions, of which the policy keeps nothing: its graph could be neither copied nor pickled."""
        kept = self.policy.action_dist
        self.policy.action_dist = copy.copy(kept)
        try:
            return self.policy.get_distribution(observation)
        finally:
            self.policy.action_dist = kept

    def normalised(self, observation: Tensor) -> Tensor:
        """The observation as the model's networks receive it."""
        if not self.clip:
            return observation
        shown = (observation.double() - self.mean) / self.deviation
        return shown.clamp(-self.clip, self.clip).to(observation.dtype)

    def _scaled(self, action: Tensor) -> Tensor:
        """An action of the space's range on the [-1, 1] scale."""
        return (2 * (action - self.low) / (self.high - self.low) - 1).clamp(-1, 1)

    @torch.no_grad()
    def check(self, observation: Tensor) -> None:
        """Compare actions with the model's own `predict(deterministic=True)`.

        Args:
            observation: observations [N, *shape].

        Raises:
            UserError: if they differ: then its policy has code of its own, which computes otherwise.
        """
        answer = self(observation)
        wanted, _ = copy.deepcopy(self.policy).predict(self.normalised(observation).numpy(), deterministic=True)
        if self.range is None:
            same = bool((answer.argmax(-1).numpy() == wanted).all())
        else:
            shown = self.low + (answer.clamp(-1, 1) + 1) / 2 * (self.high - self.low)
            same = bool(
                np.allclose(
                    shown.numpy(), wanted.reshape(shown.shape), atol=CLOSE * float((self.high - self.low).max())
                )
            )
        if not same:
            raise UserError(
                f"{type(self.policy).__name__} of the model acts otherwise than its predict(deterministic=True). {INSTEAD}"
            )


def network_of(
    model: Any, facts: DrivingFacts, observation: Tensor
) -> tuple[ModelNetwork, Callable[[Tensor], Tensor] | None]:
    """The network of a model that fits a world, and what converts the world's observations for it (`Expected.fit`).

    Args:
        model: the model.
        facts: facts of the world.
        observation: observations of the world [B, V, F].

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
    native = expected.fit(name, network.shape, network.bounds)
    if not network.clip:
        last, raw = (_kept(model, key, network.bounds) for key in ("_last_obs", "_last_original_obs"))
        # A model that still has both is as it was trained; `load(env=...)` and `set_env` drop the last observation.
        live = model.get_env() is not None and last is not None
        normaliser = model.get_vec_normalize_env()
        behind = normaliser is None and not live and getattr(model, "_last_original_obs", None) is not None
        check_traces(name, expected, last, raw, behind, native=native is not None, algorithm=network.algorithm)
    shown = observation if native is None else native(observation)
    network.check(shown.reshape(-1, *network.shape))
    return network, native


def _kept(model: Any, name: str, bounds: Bounds) -> Any:
    """The last observations of a model's training [n, V * F]; None if it keeps none."""
    kept = getattr(model, name, None)
    size = int(np.prod(bounds.shape))
    return kept.reshape(-1, size) if isinstance(kept, np.ndarray) and kept.size and kept.size % size == 0 else None


def _copied(policy: Any) -> Any:
    """A copy of a model's policy, without the distributions of its last forward pass: torch copies no tensor with a graph."""
    kept = [part.action_dist for part in policy.modules() if getattr(part, "action_dist", None) is not None]
    empty = {id(one): _empty(copy.copy(one)) for one in kept}
    return copy.deepcopy(policy, dict(empty))


def _empty(distribution: Any) -> Any:
    """The distribution without what it computed, or drew for an exploration."""
    for name, value in vars(distribution).items():
        if isinstance(value, Tensor | torch.distributions.Distribution):
            setattr(distribution, name, None)
    return distribution


class ModelCritic(nn.Module):
    """The critic of a model with an actor: (observation and action, concatenated) [N, *] to values [N, 1].

    Args:
        network: the network of the model.
    """

    network: ModelNetwork

    def __init__(self, network: ModelNetwork) -> None:
        super().__init__()
        # Not a submodule: the policy has it already.
        object.__setattr__(self, "network", network)

    def forward(self, entries: Tensor) -> Tensor:
        network = self.network
        leading, width = entries.shape[:-1], network.width
        observation, action = entries.flatten(0, -2).split([entries.shape[-1] - width, width], -1)
        shown = network.normalised(observation.reshape(-1, *network.shape))
        return network.policy.critic(shown, action)[0].reshape(*leading, 1)


def critic_of(network: ModelNetwork) -> ModelCritic | None:
    """The critic of a model; None if it has none."""
    return ModelCritic(network) if network.algorithm in ACTOR else None


_KNOWN = (*VALUES, *DISTRIBUTION, *ACTOR)
