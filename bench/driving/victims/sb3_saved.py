"""What the text in a saved model of Stable-Baselines3 says: the algorithm, the spaces, the activation, the last observation.

`data` is JSON with two versions of every object: a pickle, which nothing here unpickles, and text.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from torch import nn

from cavbench.archive import Archive
from cavbench.driving import ActionType
from cavbench.driving.victims.spaces import Bounds
from cavbench.errors import UserError, short
from cavbench.formats.pickled import floats
from cavbench.formats.trial import hashed

Algorithm = Literal["dqn", "ppo", "a2c", "sac", "td3", "ddpg", "recurrent_ppo"]
POLICIES: dict[str, tuple[Algorithm, ...]] = {
    "stable_baselines3.dqn.policies": ("dqn",),
    "stable_baselines3.common.policies": ("ppo", "a2c"),
    "stable_baselines3.sac.policies": ("sac",),
    "stable_baselines3.td3.policies": ("td3", "ddpg"),
    "sb3_contrib.common.recurrent.policies": ("recurrent_ppo",),
}
"""The algorithms whose MlpPolicy is in a module."""
FORMAT = "a model of Stable-Baselines3"
NUMBER = re.compile(r"[-+]?(?:inf|nan|\d+\.?\d*(?:e[-+]?\d+)?|\.\d+(?:e[-+]?\d+)?)")


@dataclass(frozen=True, kw_only=True)
class Saved:
    """A saved model without its weights.

    Args:
        name: the file in errors.
        algorithm: the algorithm of the training.
        observation: its observation space.
        actions: type of its actions.
        width: number of its discrete actions, or of its controls.
        range: range of its continuous actions; None for discrete ones.
        options: its `policy_kwargs`.
        last: the last observations of the training [n, V * F], if the file has them.
        raw: those before `VecNormalize`, if the file has them.
        kept: whether it has an observation from before a `VecNormalize` (`check_traces`).
    """

    name: str
    algorithm: Algorithm
    observation: Bounds
    actions: ActionType
    width: int
    range: Bounds | None
    options: Mapping[str, Any]
    last: NDArray[np.float32] | None
    raw: NDArray[np.float32] | None
    kept: bool

    @property
    def activation(self) -> type[nn.Module]:
        """The activation between its layers.

        Raises:
            UserError: if it is not one of torch's.
        """
        named = self.options.get("activation_fn")
        if named is None:
            return nn.Tanh if self.algorithm in ("ppo", "a2c", "recurrent_ppo") else nn.ReLU
        match = re.fullmatch(r"<class 'torch\.nn\.modules\.activation\.(\w+)'>", str(named))
        activation = getattr(nn, match[1], None) if match else None
        if not (isinstance(activation, type) and issubclass(activation, nn.Module)):
            raise UserError(f"{self.name} has the activation {short(str(named))}, which is not one of torch's")
        return activation


def saved_model(given: str) -> Saved:
    """What the text of a saved model says.

    Args:
        given: path of the file.

    Raises:
        UserError: if it cannot be read, or is of another algorithm or policy than those that are supported.
    """
    return _saved(given, hashed(given, "policy"))


@lru_cache(16)
def _saved(given: str, sha256: str) -> Saved:
    text = Archive.read(Path(given).expanduser(), given).member("data")
    try:
        return _read(given, json.loads(text))
    # Text of a stranger: it may be no JSON, or JSON of another form.
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        raise UserError(f"{given} cannot be read: it is not {FORMAT}, or a damaged one") from error


def _read(name: str, data: Mapping[str, Any]) -> Saved:
    algorithm = _algorithm(name, data)
    options = data.get("policy_kwargs") or {}
    if strange := set(options.get("lstm_kwargs") or {}) - {"dropout"}:
        raise UserError(f"{name} has an LSTM with {', '.join(sorted(map(str, strange)))}; {ONLY}")
    extractor = str(options.get("features_extractor_class", "FlattenExtractor'>"))
    if not extractor.endswith("FlattenExtractor'>"):
        raise UserError(
            f"{name} has the features extractor {short(extractor)}, whose code is not in it: give cavbench.score the model itself"
        )
    observation = data["observation_space"]
    if not _is(observation, "Box"):
        raise UserError(f"{name} was trained on observations of {_type(observation)}; the type must be Box")
    shown = _bounds(observation)
    pictures = str(observation.get("dtype")) == "uint8" and len(shown.shape) == 3
    if pictures and (shown.low, shown.high) == ((0.0,), (255.0,)) and options.get("normalize_images", True):
        raise UserError(
            f"{name} was trained on pictures of uint8, which Stable-Baselines3 divides by 255: give cavbench.score the model "
            "itself, or train it with policy_kwargs={'normalize_images': False}"
        )
    actions = data["action_space"]
    discrete = _is(actions, "Discrete")
    if not discrete and not _is(actions, "Box"):
        raise UserError(f"{name} was trained for actions of {_type(actions)}; the type must be Discrete or Box")
    if discrete and int(actions.get("start", 0)):
        raise UserError(f"{name} numbers its actions from {actions['start']}; they must be numbered from 0")
    between = None if discrete else _bounds(actions)
    size = math.prod(shown.shape)
    last, raw = (_array(data.get(key), size) for key in ("_last_obs", "_last_original_obs"))
    return Saved(
        name=name,
        algorithm=algorithm,
        observation=shown,
        actions="discrete" if discrete else "continuous",
        width=int(actions["n"]) if between is None else math.prod(between.shape),
        range=between,
        options=options,
        last=last,
        raw=raw,
        kept=data.get("_last_original_obs") is not None,
    )


ONLY = (
    "victim 'sb3' reads the MlpPolicy of Stable-Baselines3's DQN, PPO, A2C, SAC, TD3 and DDPG, and the MlpLstmPolicy of "
    "sb3-contrib's RecurrentPPO"
)


def _algorithm(name: str, data: Mapping[str, Any]) -> Algorithm:
    """The algorithm: the policy's module says the family, the settings say which member."""
    module = str(data["policy_class"]["__module__"])
    family = POLICIES.get(module)
    made = re.search(r"<function (\w+)\.", str(data["policy_class"].get("__init__")))
    policy = made[1] if made else ""
    if family is not None and "MultiInput" in policy:
        # The module has policies of several algorithms, and the file says which by what it trains with.
        algorithm = {"ppo": "PPO" if "clip_range" in data else "A2C", "td3": "TD3"}.get(family[0], family[0].upper())
        package, algorithm = (
            ("sb3_contrib", "RecurrentPPO") if "lstm" in module + policy.lower() else ("stable_baselines3", algorithm)
        )
        raise UserError(
            f"{name} has a MultiInputPolicy, for a Dict of observations: victim=sb3 reads a Box. From Python the model itself is "
            f'scored: cavbench.score({package}.{algorithm}.load("{name}"), "pgd", world="ID of its environment")'
        )
    if family is None or "Cnn" in policy:
        raise UserError(f"{name} has the policy {short(policy or module)} of {short(module)}; {ONLY}")
    if family == ("ppo", "a2c"):
        # TRPO of sb3-contrib uses the same class of policies.
        if "cg_max_steps" in data:
            raise UserError(f"{name} is of TRPO; {ONLY}")
        return "ppo" if "clip_range" in data else "a2c"
    if family == ("td3", "ddpg"):
        # DDPG is TD3 without its delay and its noise.
        return "ddpg" if (data["policy_delay"], data["target_noise_clip"]) == (1, 0.0) else "td3"
    return family[0]


def _is(space: Mapping[str, Any], kind: str) -> bool:
    return str(space.get(":type:")).endswith(f".{kind}'>")


def _type(space: Mapping[str, Any]) -> str:
    found = re.fullmatch(r"<class '(?:\w+\.)*(\w+)'>", str(space.get(":type:")))
    return found[1] if found else short(str(space.get(":type:")))


def _bounds(space: Mapping[str, Any]) -> Bounds:
    shape = tuple(int(side) for side in space["_shape"])
    low, high = (_numbers(str(space[side]), math.prod(shape)) for side in ("low", "high"))
    return Bounds(shape=shape, low=low, high=high)


def _numbers(text: str, count: int) -> tuple[float, ...]:
    """The numbers of a printed array; one if they are all equal. Of a long array numpy prints the ends only."""
    found = [float(number) for number in NUMBER.findall(text)]
    if len(set(found)) == 1:
        return (found[0],)
    if len(found) != count:
        raise ValueError(f"{len(found)} of {count} numbers")
    return tuple(found)


def _array(value: Any, size: int) -> NDArray[np.float32] | None:
    pickled = value.get(":serialized:") if isinstance(value, dict) else None
    return floats(pickled, size) if isinstance(pickled, str) and size > 0 else None
