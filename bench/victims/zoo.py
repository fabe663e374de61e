"""The zoo: trained policies and detectors as safetensors with a card each, hash-checked when loaded. Nothing is unpickled."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from platformdirs import user_data_path
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from bench.detection import Detector
from bench.driving import Policy
from bench.errors import UserError
from bench.files import whole

Network = TypeVar("Network", bound=Policy | Detector)

SHIPPED = Path(__file__).parent / "policies"


def own() -> Path:
    """Where networks trained on this machine are kept: CAVBENCH_ZOO, or the user's data folder."""
    return Path(os.environ.get("CAVBENCH_ZOO") or user_data_path("cavbench") / "zoo")


def save(
    network: Policy | Detector, card: Mapping[str, object], *, name: str, seed: int, root: Path | None = None
) -> Path:
    """Write the weights and the card of a trained network, atomically, and return the path of the weights.

    Args:
        network: has an attribute `shape`, the keyword arguments of its class. A detector's kernels are kept in half precision.
        card: what is worth knowing of the training; the hash of the weights and the shape are added.
        name: of the zoo entry, for instance `dqn-advtrain-skip0.3`.
        seed: training seed.
        root: a zoo; the user's own by default, which is looked at before the shipped one.
    """
    folder = (root or own()) / name
    folder.mkdir(parents=True, exist_ok=True)
    state = {key: value.contiguous() for key, value in network.state_dict().items()}
    if isinstance(network, Detector):
        state = {key: value.half() if value.ndim > 1 else value for key, value in state.items()}
    blob = save_tensors(state)
    full = {"name": name, **card, "shape": network.shape, "sha256": hashlib.sha256(blob).hexdigest()}
    path = folder / f"seed{seed}.safetensors"
    with whole(path) as file:
        file.write(blob)
    with whole(path.with_suffix(".json")) as file:
        file.write(json.dumps(full, indent=1, sort_keys=True).encode() + b"\n")
    return path


def card(name: str, seed: int) -> dict[str, Any]:
    """The card of a zoo entry.

    Raises:
        UserError: if there is none, with the command that trains it, or if it cannot be read.
    """
    path = _find(name, seed).with_suffix(".json")
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"the card {path} cannot be read: {error}") from None


def load(
    name: str, seed: int, build: Callable[..., Network], *, made_by: Mapping[str, Mapping[str, object]]
) -> Network:
    """The network of a zoo entry, frozen and in eval mode.

    Args:
        name: of the entry.
        seed: training seed.
        build: makes the network that is filled with the weights, of the card's `shape`; its class, for instance.
        made_by: the parameters the card must have been made with, by component: what was asked for is what is loaded.

    Raises:
        UserError: if there is no such entry, it was made with other parameters, or its weights are not those of its card.
    """
    path, entry = _find(name, seed), card(name, seed)
    for component, parameters in made_by.items():
        made = entry.get(component, {})
        if wrong := [
            f"{key}={made.get(key)}, not {value}" for key, value in parameters.items() if made.get(key) != value
        ]:
            raise UserError(
                f"the zoo's {name!r} of training seed {seed} was made with {component}.{'; '.join(wrong)}; "
                "`bench train` with the same words makes the one you asked for"
            )
    blob = path.read_bytes()
    found = hashlib.sha256(blob).hexdigest()
    if found != entry.get("sha256"):
        raise UserError(
            f"the weights {path} have sha256 {found[:12]}…, their card says {str(entry.get('sha256'))[:12]}…: "
            "the file was changed; restore it or train it again"
        )
    try:
        network: Network = build(**entry["shape"])
        network.load_state_dict(load_tensors(blob))
    except (SafetensorError, RuntimeError, TypeError, KeyError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"the weights {path} do not fit {name!r}: {reason}") from None
    network.weights_sha256 = found
    network.requires_grad_(False).eval()
    return network


def seeds(name: str) -> list[int]:
    """The training seeds of an entry, in the user's zoo and the shipped one."""
    files = [path for root in (own(), SHIPPED) for path in (root / name).glob("seed*.safetensors")]
    return sorted({int(path.stem.removeprefix("seed")) for path in files})


def _find(name: str, seed: int) -> Path:
    for root in (own(), SHIPPED):
        path = root / name / f"seed{seed}.safetensors"
        if path.exists():
            return path
    known = seeds(name)
    have = f"it has seeds {', '.join(map(str, known))}" if known else "it has no such entry"
    raise UserError(f"the zoo has no {name!r} of training seed {seed} ({have}); `bench train` makes one")
