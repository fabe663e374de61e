"""The network of a saved model of Stable-Baselines3, rebuilt from the names and the sizes of its weights."""

from __future__ import annotations

import math
import re

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from cavbench.driving.victims.remembering import Memory
from cavbench.driving.victims.sb3_saved import ONLY, Algorithm, Saved
from cavbench.driving.victims.sb3_seen import Normaliser
from cavbench.driving.victims.spaces import Bounds
from cavbench.errors import UserError

LSTM = r"(weight|bias)_(ih|hh)_l\d+"
STEMS: dict[Algorithm, tuple[str, ...]] = {
    "dqn": ("q_net.q_net",),
    "ppo": ("mlp_extractor.policy_net", "action_net"),
    "a2c": ("mlp_extractor.policy_net", "action_net"),
    "sac": ("actor.latent_pi", "actor.mu"),
    "td3": ("actor.mu",),
    "ddpg": ("actor.mu",),
    "recurrent_ppo": ("mlp_extractor.policy_net", "action_net"),
}
"""Names of the layers from the observation to the action, in order."""
OTHERS: dict[Algorithm, str] = {
    "dqn": r"q_net_target\.q_net",
    "ppo": r"mlp_extractor\.value_net|value_net|log_std",
    "a2c": r"mlp_extractor\.value_net|value_net|log_std",
    "sac": r"actor\.log_std|critic\.qf\d+|critic_target\.qf\d+",
    "td3": r"actor_target\.mu|critic\.qf\d+|critic_target\.qf\d+",
    "ddpg": r"actor_target\.mu|critic\.qf\d+|critic_target\.qf\d+",
    "recurrent_ppo": rf"mlp_extractor\.value_net|value_net|log_std|critic|lstm_critic\.{LSTM}|lstm_actor\.{LSTM}",
}
"""Names of the layers that do not choose the action. Any other layer belongs to another kind of policy."""
BOTH = ("ppo", "a2c", "recurrent_ppo")
"""Algorithms that support both action types; the others support one."""
CRITIC = "critic.qf0"
CLIP_MEAN = 2.0
"""The default of SAC's `clip_mean`, which limits the mean of an action of gSDE before it is squashed."""


class NormalisedCritic(nn.Module):
    """A critic of normalised observations: (observation and action, concatenated) to values.

    Args:
        critic: the critic.
        normaliser: the statistics of the observation.
    """

    def __init__(self, critic: nn.Module, normaliser: Normaliser) -> None:
        super().__init__()
        self.critic, self.normaliser = critic, normaliser

    def forward(self, entries: Tensor) -> Tensor:
        size = math.prod(self.normaliser.shape)
        shown = self.normaliser(entries[..., :size].unflatten(-1, self.normaliser.shape))
        values: Tensor = self.critic(torch.cat((shown.flatten(-len(self.normaliser.shape)), entries[..., size:]), -1))
        return values


class Recurrent(nn.Module):
    """A network behind an LSTM, as one that remembers (`RememberingPolicy`).

    Args:
        before: what precedes the LSTM.
        lstm: the LSTM.
        after: what follows it.
    """

    def __init__(self, before: nn.Module, lstm: nn.LSTM, after: nn.Module) -> None:
        super().__init__()
        self.before, self.lstm, self.after = before, lstm, after

    @property
    def memory(self) -> Memory:
        entry = (self.lstm.num_layers, self.lstm.hidden_size), torch.float32
        return {"h": entry, "c": entry}

    def forward(self, observation: Tensor, memory: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        states = tuple(memory[name].transpose(0, 1).contiguous() for name in ("h", "c"))
        hidden, after = self.lstm(self.before(observation)[None], states)
        entries = {name: state.transpose(0, 1) for name, state in zip(("h", "c"), after, strict=True)}
        return self.after(hidden[0]), TensorDict(entries, batch_size=observation.shape[:1])


def normalised(network: nn.Module, normaliser: Normaliser) -> nn.Module:
    """The network on observations that are normalised first."""
    if isinstance(network, Recurrent):
        return Recurrent(nn.Sequential(normaliser, network.before), network.lstm, network.after)
    return nn.Sequential(normaliser, network)


class Scaled(nn.Module):
    """Actions of a range on the [-1, 1] scale.

    Args:
        bounds: the range.
    """

    low: Tensor
    high: Tensor

    def __init__(self, bounds: Bounds) -> None:
        super().__init__()
        low, high = zip(*bounds.limits(), strict=True)
        self.register_buffer("low", torch.tensor(low))
        self.register_buffer("high", torch.tensor(high))

    def forward(self, action: Tensor) -> Tensor:
        return 2 * (action - self.low) / (self.high - self.low) - 1


def network_in(saved: Saved, weights: dict[str, Tensor]) -> nn.Module:
    """The map from flattened observations to values of the actions, or to actions on the [-1, 1] scale."""
    stems = STEMS[saved.algorithm]
    known = rf"({'|'.join([*map(re.escape, stems), OTHERS[saved.algorithm]])})(\.\d+)?(\.(weight|bias))?"
    if strange := [key for key in weights if not re.fullmatch(known, key)]:
        raise UserError(
            f"{saved.name} has the weights {strange[0]!r}, which no MlpPolicy of {saved.algorithm} has; {ONLY}"
        )
    if any(key.endswith("weight") and weight.ndim != 2 for key, weight in weights.items()):
        raise UserError(
            f"{saved.name} has layers with weights between its linear ones ({saved.activation.__name__}); {ONLY}"
        )
    layers = [layer for stem in stems for layer in _layers(weights, stem)]
    if not layers:
        raise UserError(f"{saved.name} has no {saved.algorithm} policy: {stems[0]} is not among its weights")
    after = nn.Sequential(*_stack(layers, saved.activation), *_head(saved, weights))
    lstm = _lstm(weights) if saved.algorithm == "recurrent_ppo" else None
    inputs = layers[0][0].shape[1] if lstm is None else lstm.input_size
    entries = math.prod(saved.observation.shape)
    if inputs != entries:
        raise UserError(
            f"{saved.name} has a policy with {inputs} inputs, its observation has {entries} numbers; {ONLY}"
        )
    return nn.Sequential(nn.Flatten(), after) if lstm is None else Recurrent(nn.Flatten(), lstm, after)


def critic_in(saved: Saved, weights: dict[str, Tensor]) -> nn.Module | None:
    """The first critic, of observation and action, concatenated; None if there is none."""
    critic = _layers(weights, CRITIC)
    return nn.Sequential(*_stack(critic, saved.activation)) if critic else None


def _lstm(weights: dict[str, Tensor]) -> nn.LSTM:
    """The LSTM of the actor."""
    own = {key.removeprefix("lstm_actor."): weight for key, weight in weights.items() if key.startswith("lstm_actor.")}
    hidden, layers = own["weight_hh_l0"].shape[1], sum(name.startswith("weight_hh") for name in own)
    lstm = nn.LSTM(own["weight_ih_l0"].shape[1], hidden, layers)
    lstm.load_state_dict(own)
    return lstm


def _head(saved: Saved, weights: dict[str, Tensor]) -> list[nn.Module]:
    """What follows the last layer of a continuous policy."""
    if saved.range is None:
        return []
    if saved.algorithm in BOTH:
        if saved.options.get("squash_output"):
            return [nn.Tanh()]
        return [] if set(saved.range.limits()) == {(-1.0, 1.0)} else [Scaled(saved.range)]
    # With gSDE, SAC limits the mean: its layer is then the first of two.
    clipped = saved.algorithm == "sac" and "actor.mu.0.weight" in weights
    limit = float(saved.options.get("clip_mean", CLIP_MEAN))
    return [*([nn.Hardtanh(-limit, limit)] if clipped else []), nn.Tanh()]


def _layers(weights: dict[str, Tensor], stem: str) -> list[tuple[Tensor, Tensor]]:
    """Weight and bias of the linear layers under a name: a numbered sequence or a single layer."""
    numbers = sorted(
        int(found[1]) for key in weights if (found := re.fullmatch(rf"{re.escape(stem)}\.(\d+)\.weight", key))
    )
    names = [f"{stem}.{number}" for number in numbers] or ([stem] if f"{stem}.weight" in weights else [])
    return [(weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in names]


def _stack(layers: list[tuple[Tensor, Tensor]], activation: type[nn.Module]) -> list[nn.Module]:
    """The layers with an activation between them."""
    modules: list[nn.Module] = []
    for weight, bias in layers:
        linear = nn.Linear(weight.shape[1], weight.shape[0])
        linear.load_state_dict({"weight": weight, "bias": bias})
        modules += [linear, activation()]
    return modules[:-1]
