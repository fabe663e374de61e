"""What a model's last observations of its training say about its environment: was it this world, seen as it is?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavbench.driving.victims.spaces import FEATURES_THERE, Expected, configured, task_of
from cavbench.errors import UserError

EXACT = 1e-6
BEYOND = 0.01
"""An observation of the world's own environment may leave a declared range by this share of it."""
ON_POLICY = ("PPO", "A2C")
FARTHEST_M, BEHIND_M = 200.0, 10.0
"""How far ahead highway-env shows a car, and how far behind unless `see_behind`."""


def check_traces(
    name: str,
    expected: Expected,
    last: NDArray[np.float32] | None,
    raw: NDArray[np.float32] | None,
    kept: bool,
    *,
    native: bool,
    algorithm: str,
) -> None:
    """Refuse a model whose environment changed the world's observations in a way that is not applied here.

    Stable-Baselines3 keeps the last observations of a training, also in the file. Those of a model behind `VecNormalize` are
    normalised; the statistics are with the environment, and in no file of the model. PPO and A2C keep the observation before
    `VecNormalize` only behind it. The others always do: without it, the one before the last.

    Args:
        name: the model in errors.
        expected: what the world shows.
        last: the last observations of the training [n, V * F]; None if they are not known.
        raw: the same before `VecNormalize`; for PPO and A2C the first ones.
        kept: whether there is such a `raw`, and no environment that tells.
        native: whether the observations are in the format of the world's own environment.
        algorithm: name of its class.

    Raises:
        UserError: if they are no observations of the world, or nothing tells.
    """
    plain = not native and last is not None
    what = _strange(last, expected) if plain else ""
    whole = f'{algorithm}.load("model.zip", env=VecNormalize.load("statistics.pkl", venv))'
    if kept and algorithm not in ON_POLICY and last is None:
        raise UserError(
            f"{name} has no last observation of its training, so nothing tells whether it was trained behind VecNormalize: load "
            f'it without env=, {algorithm}.load("model.zip"), or with its statistics, {whole}'
        )
    if algorithm in ON_POLICY:
        normalised = kept and not (_equal(last, raw) or (plain and not what))
    else:
        # Without VecNormalize the one before the last is as strange as the last.
        strange = what and raw is not None and not _strange(raw, expected)
        normalised = kept and bool(strange or (native and _beyond(last, raw, expected)))
    if normalised:
        raise UserError(
            f"{name} was trained behind VecNormalize, whose statistics are not in it: add the file of VecNormalize.save, "
            f"victim.normalize=statistics.pkl, or give the model with its environment, cavbench.score({whole}), or train it "
            "without norm_obs"
        )
    if plain and task_of(expected.facts) and (what := what or _other_view(last, expected)):
        raise UserError(
            f"the last observation of {name} in its training is none of this world: {what}. "
            f"{configured(expected.facts, FEATURES_THERE)}. If a wrapper changed them, give cavbench.score a torch.nn.Module "
            "that does the same"
        )
    if what:
        raise UserError(
            f"the last observation of {name} in its training is none of this world: {what}. A wrapper of its environment has "
            "changed them (VecNormalize, another order of features): give cavbench.score a torch.nn.Module that does the same"
        )


def _beyond(last: NDArray[np.float32] | None, raw: NDArray[np.float32] | None, expected: Expected) -> bool:
    """Whether an entry of the last observation leaves its declared range, and the same one before `VecNormalize` does not."""
    if last is None or raw is None or last.shape != raw.shape:
        return False
    features = expected.facts.features
    low, high = np.array(features.low), np.array(features.high)
    spare = BEYOND * (high - low)
    outside, other = ((one < low - spare) | (one > high + spare) for one in (last, raw))
    return bool((outside & ~other).any())


def _equal(last: NDArray[np.float32] | None, raw: NDArray[np.float32] | None) -> bool:
    return last is not None and raw is not None and last.shape == raw.shape and bool(np.allclose(last, raw, atol=EXACT))


def _strange(last: NDArray[np.float32] | None, expected: Expected) -> str:
    """What no observation of the world has: a presence other than 0 and 1, an absent ego, an absent row that is not 0."""
    assert last is not None
    rows = last.reshape(len(last), -1, expected.shape[1])
    presence = rows[..., 0]
    if not bool(np.isfinite(rows).all()):
        return "it is not finite"
    if (other := presence[(presence != 0) & (presence != 1)]).size:
        return f"the presence of a car, the first feature of its row, is {other[0]:g} instead of 0 or 1"
    if not (presence[:, 0] == 1).all():
        return "the ego, its first row, is absent"
    if bool((rows[presence == 0] != 0).any()):
        return "a row without a car is not 0"
    if float(np.abs(rows).max()) > 1 + EXACT:
        return f"it has the value {float(np.abs(rows).max()):g}, beyond [-1, 1]"
    return ""


def _other_view(last: NDArray[np.float32] | None, expected: Expected) -> str:
    """What highway-env shows with other keys of `observation` only: cars too far ahead or behind."""
    assert last is not None
    features = expected.facts.features
    column, reach = 1 + features.names.index("x"), features.high[features.names.index("x")]
    rows = last.reshape(len(last), -1, expected.shape[1])[:, 1:]
    ahead = reach * rows[..., column][rows[..., 0] == 1]
    if ahead.size and float(ahead.min()) < -BEHIND_M * (1 + EXACT):
        return f"it has a car {-float(ahead.min()):.0f} m behind (see_behind: true shows such cars)"
    if ahead.size and reach >= FARTHEST_M and float(ahead.max()) >= FARTHEST_M * (1 - EXACT):
        return f"it has a car {float(ahead.max()):.0f} m ahead (absolute: true, or a smaller features_range, shows such values)"
    return ""
