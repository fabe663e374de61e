"""The network of a Stable-Baselines3 model object, as a map from observations to values or actions.

Nothing is imported from Stable-Baselines3: the object brings its own code.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn

from bench.driving import ActionType
from bench.errors import UserError

VALUES, DISTRIBUTION, ACTOR = ("DQN",), ("PPO", "A2C"), ("SAC", "TD3", "DDPG")
LIBRARY = "stable-baselines3"


def is_model(given: object) -> bool:
    """Whether an object is a model of Stable-Baselines3 or sb3-contrib."""
    packages = {base.__module__.partition(".")[0] for base in type(given).__mro__}
    return "stable_baselines3" in packages and hasattr(given, "policy")


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
        if not self.algorithm:
            raise UserError(
                f"models of Stable-Baselines3's {type(model).__name__} are not supported; supported: {', '.join(_KNOWN)}. "
                "Give the torch.nn.Module from observation to values or actions instead"
            )
        space, actions = model.observation_space, model.action_space
        if type(space).__name__ != "Box":
            raise UserError(f"the model takes observations of {space}; the type must be Box")
        self.shape = tuple(space.shape)
        self.action_type: ActionType = "discrete" if type(actions).__name__ == "Discrete" else "continuous"
        self.width = int(actions.n) if self.action_type == "discrete" else int(actions.shape[0])
        self.policy = _copied(model.policy).cpu()
        self.policy.set_training_mode(False)
        if self.action_type == "continuous":
            self.register_buffer("low", torch.as_tensor(actions.low))
            self.register_buffer("high", torch.as_tensor(actions.high))
        self._set_normalisation(model.get_vec_normalize_env())

    def _set_normalisation(self, env: Any) -> None:
        self.clip = 0.0
        if env is None or not env.norm_obs:
            return
        self.clip = float(env.clip_obs)
        self.register_buffer("mean", torch.as_tensor(env.obs_rms.mean, dtype=torch.float32))
        spread = torch.as_tensor(env.obs_rms.var, dtype=torch.float32) + env.epsilon
        self.register_buffer("deviation", spread.sqrt())

    def forward(self, observation: Tensor) -> Tensor:
        """Q-values or logits [N, A], or actions [N, 2] in [-1, 1], of observations [N, *shape]."""
        observation = self.normalised(observation)
        if self.algorithm in VALUES:
            return self.policy.q_net(observation)
        if self.algorithm in ACTOR:
            # Actors answer in [-1, 1]; `predict` scales that to the range of the actions.
            return self.policy.actor(observation)
        distribution = self.policy.get_distribution(observation).distribution
        self.policy.action_dist.distribution = None  # Its graph could be neither copied nor pickled.
        return distribution.logits if self.action_type == "discrete" else self._scaled(distribution.mean)

    def normalised(self, observation: Tensor) -> Tensor:
        """The observation as the model's networks receive it."""
        if not self.clip:
            return observation
        return ((observation - self.mean) / self.deviation).clamp(-self.clip, self.clip)

    def _scaled(self, action: Tensor) -> Tensor:
        """An action of the space's range on the [-1, 1] scale."""
        return (2 * (action - self.low) / (self.high - self.low) - 1).clamp(-1, 1)


def _copied(policy: Any) -> Any:
    """A copy of a model's policy, without the distribution of its last forward pass: torch copies no tensor with a graph."""
    kept = getattr(policy, "action_dist", None)
    if kept is None:
        return copy.deepcopy(policy)
    empty = copy.copy(kept)
    empty.distribution = None
    return copy.deepcopy(policy, {id(kept): empty})


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
