"""The network of a Stable-Baselines3 model object, as a map from observations to values or actions.

Nothing is imported from Stable-Baselines3: the object brings its own code.
"""

from __future__ import annotations

import copy
import inspect
import math
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from cavbench.driving import ActionType
from cavbench.driving.victims.remembering import BEGUN, Memory, empty
from cavbench.driving.victims.sb3_seen import Normaliser
from cavbench.driving.victims.spaces import Bounds
from cavbench.errors import UserError, short

VALUES, DISTRIBUTION, ACTOR = ("DQN",), ("PPO", "A2C"), ("SAC", "TD3", "DDPG")
RECURRENT = "RecurrentPPO"
"""The algorithm of sb3-contrib that is read, too."""
LIBRARY = "stable-baselines3"
LIBRARIES = ("stable_baselines3", "sb3_contrib")
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
    return bool(packages & {*LIBRARIES}) and "deterministic" in parameters


class ModelNetwork(nn.Module):
    """What a model computes before it chooses: `predict(deterministic=True)` takes the largest value, or the action itself.

    Differentiable in the observation, and any batch size. Observations are normalised as by the model's VecNormalize, if any.

    Args:
        model: a DQN, PPO, A2C, SAC, TD3 or DDPG, or sb3-contrib's RecurrentPPO.

    Raises:
        UserError: if it is another algorithm, or its spaces are not supported.
    """

    low: Tensor
    high: Tensor

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.algorithm = next((base.__name__ for base in type(model).__mro__ if base.__name__ in _KNOWN), "")
        contrib = type(model).__module__.startswith("sb3_contrib")
        if not self.algorithm or contrib != (self.algorithm == RECURRENT):
            raise UserError(
                f"models of {type(model).__module__.partition('.')[0]}'s {type(model).__name__} are not supported; "
                f"supported: {', '.join(_KNOWN[:-1])} of Stable-Baselines3, and {RECURRENT} of sb3-contrib. {INSTEAD}"
            )
        own = "predict" in vars(model) or type(model).predict.__module__.partition(".")[0] not in LIBRARIES
        if own:
            raise UserError(
                f"{type(model).__name__} has a predict() of its own, by which it would not be driven. {INSTEAD}"
            )
        space, actions = model.observation_space, model.action_space
        parts = dict(space.spaces) if type(space).__name__ == "Dict" else {}
        if any(type(part).__name__ != "Box" for part in (*parts.values(), *(() if parts else (space,)))):
            raise UserError(
                f"the model takes observations of {short(str(space))}; the type must be Box, or a Dict of Boxes. {INSTEAD}"
            )
        self.parts = {name: tuple(part.shape) for name, part in parts.items()}
        if type(actions).__name__ not in ("Discrete", "Box"):
            raise UserError(
                f"the model takes actions of {short(str(actions))}; the type must be Discrete or Box. {INSTEAD}"
            )
        if int(getattr(actions, "start", 0)):
            raise UserError(f"the model numbers its actions from {actions.start}; they must be numbered from 0")
        self.bounds = Bounds.of(space) if not parts else Bounds.of_parts(parts)
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
        """The statistics of its VecNormalize: of what it is shown, or of a frame of that."""
        self.normaliser: Normaliser | None = None
        self.of_frame: Normaliser | None = None
        if env is None or not env.norm_obs:
            return
        if self.parts:
            raise UserError(f"the model was trained on parts behind VecNormalize, which is not supported. {INSTEAD}")
        found = Normaliser(env.obs_rms.mean, env.obs_rms.var, env.epsilon, float(env.clip_obs))
        if found.shape == self.shape:
            self.normaliser = found
        else:
            self.of_frame = found

    @property
    def memory(self) -> Memory:
        """What a recurrent model remembers; empty for another one."""
        if self.algorithm != RECURRENT:
            return {}
        layers, _, size = self.policy.lstm_hidden_state_shape
        return {BEGUN: ((), torch.bool), **dict.fromkeys(("h", "c"), ((layers, size), torch.float32))}

    def forward(
        self, observation: Tensor, memory: TensorDictBase | None = None
    ) -> Tensor | tuple[Tensor, TensorDictBase]:
        """Q-values or logits [N, A], or actions [N, 2] in [-1, 1], of observations [N, *shape].

        With a memory: a pair of these and the memory after them.
        """
        observation = self.normalised(observation)
        if self.algorithm == RECURRENT:
            assert memory is not None
            return self._recurrent(observation, memory)
        if self.algorithm in VALUES:
            return self.policy.q_net(observation)
        # Actors answer in [-1, 1]; `predict` scales that to the range of the actions.
        if self.algorithm == "SAC":
            mean, *_ = self.policy.actor.get_action_dist_params(observation)
            return mean.tanh()
        if self.algorithm in ACTOR:
            return self.policy.actor(observation)
        return self._chosen(self._distribution(observation))

    def _recurrent(self, observation: Tensor, memory: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        # The batch is the second axis of the library's states. A first decision starts from 0, as its `predict` does.
        states = tuple(memory[name].transpose(0, 1).contiguous() for name in ("h", "c"))
        found, after = self._distribution(observation, states, torch.zeros(len(observation), device=observation.device))
        entries = {name: state.transpose(0, 1) for name, state in zip(("h", "c"), after, strict=True)}
        entries[BEGUN] = torch.ones_like(memory[BEGUN])
        return self._chosen(found), TensorDict(entries, batch_size=observation.shape[:1])

    def _chosen(self, distribution: Any) -> Tensor:
        """The logits of a distribution of actions, or its most probable action on the [-1, 1] scale."""
        if self.action_type == "discrete":
            logits: Tensor = distribution.distribution.logits
            return logits
        mode: Tensor = distribution.mode()
        return mode if self.policy.squash_output else self._scaled(mode)

    def _distribution(self, *given: Any) -> Any:
        """The distribution of the actions, of which the policy keeps nothing: its graph could be neither copied nor pickled."""
        kept = self.policy.action_dist
        self.policy.action_dist = copy.copy(kept)
        try:
            return self.policy.get_distribution(*given)
        finally:
            self.policy.action_dist = kept

    def normalised(self, observation: Tensor) -> Any:
        """The observation as the model's networks receive it; of a `Dict` its parts, which a world shows one after the other."""
        if self.parts:
            found = observation.split([math.prod(shape) for shape in self.parts.values()], -1)
            named = zip(self.parts.items(), found, strict=True)
            return {name: part.reshape(len(observation), *shape) for (name, shape), part in named}
        return observation if self.normaliser is None else self.normaliser(observation)

    def _as_predict_takes(self, observation: Tensor) -> Any:
        """The observation as NumPy's."""
        shown = self.normalised(observation)
        return {name: part.numpy() for name, part in shown.items()} if self.parts else shown.numpy()

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
        if self.memory:
            answer, _ = self(observation, empty(self.memory, torch.arange(len(observation))))
        else:
            answer = self(observation)
        wanted, _ = copy.deepcopy(self.policy).predict(self._as_predict_takes(observation), deterministic=True)
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


_KNOWN = (*VALUES, *DISTRIBUTION, *ACTOR, RECURRENT)
