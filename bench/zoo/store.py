"""Zoo entries on disk: safetensors weights with a JSON card each. Hashes are checked on loading; nothing is unpickled.

An entry is `<name>-<first digits of the recipe's digest>/seed<k>.safetensors`; its card is the `.json` file beside it. If the
training started from a network that is loaded anyway, such as the victim's, the entry holds only the tensors that the training
changed. Its card then has the hash of the start's weights and the names of the tensors that are taken from it:

    "start": {"sha256": "dccea06f…", "tensors": ["deep.2.conv.weight", …]}
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch
from platformdirs import user_data_path
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor
from torch.nn import Module

from cavbench import bounded
from cavbench.core.contracts import World
from cavbench.errors import UserError, message
from cavbench.files import whole
from cavbench.identity.fingerprint import canonical, code_digest, libraries, machine
from cavbench.zoo.recipe import DIGITS, Part, Recipe, check_world

SHIPPED = Path(__file__).parent / "weights"


class Network(Protocol):
    """The interface of a network in the zoo: methods of torch.nn.Module, and an attribute for the hash of its weights."""

    weights_sha256: str

    def state_dict(self) -> Mapping[str, Tensor]: ...
    def load_state_dict(self, state_dict: Mapping[str, Any]) -> object: ...
    def named_parameters(self) -> Iterator[tuple[str, Tensor]]: ...
    def requires_grad_(self, requires_grad: bool) -> Any: ...
    def eval(self) -> Any: ...


class Shaped(Network, Protocol):
    """A network that can be saved.

    If its attribute `half_precision` is true, tensors with two or more dimensions are stored in half precision.
    """

    @property
    def shape(self) -> Mapping[str, object]:
        """The keyword arguments of its constructor."""


N = TypeVar("N", bound=Network)


def own() -> Path:
    """The folder of networks trained on this machine: CAVBENCH_ZOO, or the user's data folder."""
    return Path(os.environ.get("CAVBENCH_ZOO") or user_data_path("cavbench") / "zoo")


def save(
    network: Shaped,
    recipe: Recipe,
    *,
    seed: int,
    world: World,
    card: Mapping[str, object],
    start: Network | None = None,
    root: Path | None = None,
) -> Path:
    """Write the weights and the card of a trained network, atomically, and return the path of the weights.

    Args:
        network: the network to save.
        recipe: its recipe.
        seed: training seed.
        world: the training world.
        card: further facts about the training, for instance the checkpoint selection.
        start: the network that the training started from, if loading builds it again: only tensors that differ from its are
            written. A start without `weights_sha256` is ignored, because loading could not recognise it.
        root: folder of a zoo; by default the user's own, which takes precedence over the shipped one.

    Raises:
        UserError: if the recipe does not name the non-default parameters of the world, or a weight is NaN or infinite.
    """
    check_world(recipe, world)
    state = {key: value.contiguous() for key, value in network.state_dict().items()}
    if broken := _broken(state, network):
        kind = "NaN" if any(state[key].isnan().any() for key in broken) else "infinity"
        raise UserError(
            f"training {recipe.name}, seed {seed} ended with {kind} in {len(broken)} of {len(state)} tensors, {broken[0]!r} the "
            "first: nothing is saved; try a lower learning rate"
        )
    folder = (root or own()) / recipe.key
    folder.mkdir(parents=True, exist_ok=True)
    if start is not None and start.weights_sha256:
        taken = _unchanged(state, start)
        card = {**card, "start": {"sha256": start.weights_sha256, "tensors": taken}}
        state = {key: value for key, value in state.items() if key not in taken}
    if getattr(network, "half_precision", False):
        halved = {key: value.half() if value.ndim > 1 else value for key, value in state.items()}
        if large := [key for key, value in halved.items() if bool((value.isinf() & state[key].isfinite()).any())]:
            raise UserError(
                f"training {recipe.name}, seed {seed} ended with more than half precision holds (65504) in {large[0]!r}: "
                "nothing is saved; try a lower learning rate"
            )
        state = halved
    blob = save_tensors(state)
    where = Part.of("world", world)
    full = {
        **card,
        "name": recipe.name,
        "seed": seed,
        "recipe": recipe.described(),
        "world": {"name": where.name, "class": where.source, "parameters": where.parameters},
        "command": recipe.train(seed),
        "shape": network.shape,
        "sha256": hashlib.sha256(blob).hexdigest(),
        "made": _provenance((*recipe.parts, where)),
    }
    path = folder / f"seed{seed}.safetensors"
    with whole(path) as file:
        file.write(blob)
    with whole(path.with_suffix(".json")) as file:
        file.write(json.dumps(full, indent=1, sort_keys=True, default=str).encode() + b"\n")
    return path


def card(recipe: Recipe, seed: int) -> dict[str, Any]:
    """The card of an entry.

    Raises:
        UserError: if there is no entry (the message has the training command), or its card cannot be read.
    """
    path = _find(recipe, seed).with_suffix(".json")
    entry = bounded.read_json(path, name=f"the card {path}", finite=False)
    if not isinstance(entry, dict):
        raise UserError(f"the card {path} cannot be read: it is no JSON object")
    return entry


def load(recipe: Recipe, seed: int, build: Callable[..., N], *, against: str = "") -> N:
    """The network of an entry, frozen and in eval mode.

    Args:
        recipe: its recipe.
        seed: training seed.
        build: builds the network from the card's `shape` before the weights are loaded; usually its class. For an entry that
            holds only what its training changed it must return the network that the training started from.
        against: for an adversary, the hash of the weights of its victim; empty if they do not matter.

    Raises:
        UserError: if there is no such entry, a default has changed since, the weights do not match the card, an adversary
            was trained against other weights, or a training started from others.
    """
    path, entry = _entry(recipe, seed)
    if against and (before := entry.get("against")) != against:
        raise UserError(
            f"the zoo's {recipe.name!r} of training seed {seed} was trained against a victim with weights {str(before)[:12]}…, "
            f"and the victim has {against[:12]}… now; `{recipe.train(seed)}` trains it again"
        )
    blob, sha256 = _weights(path, entry)
    try:
        tensors = load_tensors(blob)
        begun = entry.get("start")
        if not begun:
            _check_sizes(build, entry["shape"], tensors)
        network: N = build(**entry["shape"])
        if begun:
            _check_start(recipe, seed, begun, network)
            tensors = _completed(tensors, begun["tensors"], network)
        network.load_state_dict(tensors)
        _check_finite(tensors, network)
    except (
        SafetensorError,
        ArithmeticError,
        AttributeError,
        LookupError,
        RuntimeError,
        TypeError,
        ValueError,
    ) as error:
        reason = message(error) or type(error).__name__
        raise UserError(f"the weights {path} do not fit {recipe.name!r}: {reason}") from None
    network.weights_sha256 = sha256
    network.requires_grad_(False).eval()
    return network


def load_part(recipe: Recipe, seed: int, name: str, part: Module) -> str:
    """Fill a part of an entry's network without the rest of it, and return the hash of the entry's weights.

    It is for a part whose training the rest played no part in.

    Args:
        recipe: the entry's recipe.
        seed: training seed.
        name: of the part in the entry's network.
        part: the part, which gets the weights.

    Raises:
        UserError: as `load`, but the network that the training started from is not looked at.
    """
    path, entry = _entry(recipe, seed)
    blob, sha256 = _weights(path, entry)
    start = f"{name}."
    try:
        stored = {key: own for key, own in load_tensors(blob).items() if key.startswith(start)}
        part.load_state_dict({key.removeprefix(start): own for key, own in stored.items()})
        _check_finite(stored, part, start)
    except (SafetensorError, RuntimeError, ValueError) as error:
        raise UserError(f"the weights {path} do not fit {recipe.name!r}: {message(error)}") from None
    return sha256


def _check_finite(tensors: Mapping[str, Tensor], network: Network | Module, start: str = "") -> None:
    """Raise ValueError where a tensor of a file has NaN, or a weight is infinite: answers would be NaN, or parts of it dead.

    Args:
        tensors: those of the file.
        network: the network, or the part of it, that was filled with them.
        start: what stands in the file before the names of the part.
    """
    if broken := _broken(tensors, network, start):
        raise ValueError(f"{broken[0]} has {'NaN' if tensors[broken[0]].isnan().any() else 'an infinite weight'}")


def _broken(tensors: Mapping[str, Tensor], network: Network | Module, start: str = "") -> list[str]:
    """The names of the tensors that have NaN, and of the weights that are infinite. Constants may be, as a mask is."""
    weights = {start + name for name, _ in network.named_parameters()}
    return [
        name
        for name, one in tensors.items()
        if one.is_floating_point() and bool((~one.isfinite() if name in weights else one.isnan()).any())
    ]


def own_files(recipe: Recipe, seed: int) -> tuple[Path, ...]:
    """The weights and the card of an entry of the user's zoo; empty if it has none, as for weights that ship in a package."""
    path = own() / recipe.key / f"seed{seed}.safetensors"
    return (path, path.with_suffix(".json")) if path.exists() else ()


def unfinished(recipe: Recipe, seed: int) -> Path:
    """The file of a training that is not finished, in the user's zoo."""
    return own() / recipe.key / f"seed{seed}.unfinished"


def seeds(recipe: Recipe) -> list[int]:
    """The training seeds of a recipe in the user's zoo and the shipped one."""
    return _seeds(recipe.key)


def missing(recipe: Recipe, seed: int) -> str:
    """The error message for a missing entry: the requested recipe, the available variants and seeds, the training command."""
    asked = " ".join([repr(recipe.name), *(["with", *recipe.options] if recipe.options else [])])
    variants = "; ".join(_variants(recipe)) or "none"
    return f"the zoo has no {asked} of training seed {seed}. Variants: {variants}. To train it: `{recipe.train(seed)}`"


def _entry(recipe: Recipe, seed: int) -> tuple[Path, dict[str, Any]]:
    """The weights file of an entry and its card."""
    path, entry = _find(recipe, seed), card(recipe, seed)
    _check_parameters(recipe, seed, entry)
    return path, entry


def _weights(path: Path, entry: Mapping[str, Any]) -> tuple[bytes, str]:
    """The content of a weights file and its hash, which is that of the card."""
    blob = bounded.content(path, most=bounded.WEIGHTS, name=f"the weights {path}")
    sha256 = hashlib.sha256(blob).hexdigest()
    if sha256 != entry.get("sha256"):
        raise UserError(
            f"the weights {path} have sha256 {sha256[:12]}…, their card says {str(entry.get('sha256'))[:12]}…: "
            "the file was changed; restore it or train it again"
        )
    return blob, sha256


def _check_parameters(recipe: Recipe, seed: int, entry: Mapping[str, Any]) -> None:
    """Check the parameters of an entry: the digest does not notice a default that has changed since."""
    for part in recipe.parts:
        made: Any = entry
        for key in ("recipe", part.kind, "parameters"):
            made = made.get(key, {})
            if not isinstance(made, dict):
                raise UserError(
                    f"the card of {recipe.name!r}, training seed {seed}, is damaged: {key} is no JSON object"
                )
        for name, value in part.parameters.items():
            if name in made and canonical(made[name]) != canonical(value):
                raise UserError(
                    f"the zoo's {recipe.name!r} of training seed {seed} was made with {part.kind}.{name}={made[name]}, "
                    f"and the default is {value} now; `{recipe.train(seed)}` trains it again"
                )


def _unchanged(state: Mapping[str, Tensor], start: Network) -> list[str]:
    """The names of the tensors that are those of the start, bit for bit."""
    own = start.state_dict()
    return [key for key, value in state.items() if key in own and torch.equal(value, own[key])]


def _check_sizes(build: Callable[..., Network], shape: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Refuse a card whose network has other sizes than the stored tensors, before it is built: a stranger may have written it.

    Raises:
        ValueError: names a tensor.
    """
    if not isinstance(build, type):
        return
    # No memory is taken on this device. What cannot be built there is built as it is.
    with suppress(RuntimeError), torch.device("meta"):
        wanted = build(**shape).state_dict()
        for name in sorted(wanted.keys() & tensors.keys()):
            if wanted[name].shape != tensors[name].shape:
                sizes = [list(one[name].shape) for one in (tensors, wanted)]
                raise ValueError(f"{name} has the sizes {sizes[0]}, the card says {sizes[1]}")


def _check_start(recipe: Recipe, seed: int, begun: Mapping[str, Any], start: Network) -> None:
    """Check that the training started from the weights of `start`."""
    if begun["sha256"] != start.weights_sha256:
        raise UserError(
            f"the training of the zoo's {recipe.name!r}, seed {seed}, started from weights {str(begun['sha256'])[:12]}…, and the "
            f"victim has {start.weights_sha256[:12] or 'unknown ones'}… now; `{recipe.train(seed)}` trains it again"
        )


def _completed(stored: Mapping[str, Tensor], taken: Sequence[str], start: Network) -> dict[str, Tensor]:
    """The stored tensors and those taken from the start; each tensor comes from one of the two."""
    own = start.state_dict()
    if both := stored.keys() & set(taken):
        raise KeyError(f"{min(both)} is stored, and taken from the start")
    return {**stored, **{key: own[key] for key in taken}}


def _find(recipe: Recipe, seed: int) -> Path:
    for root in roots():
        path = root / recipe.key / f"seed{seed}.safetensors"
        if path.exists():
            return path
    raise UserError(missing(recipe, seed))


def roots() -> tuple[Path, Path]:
    """The user's zoo, which takes precedence, and the shipped one."""
    return own(), SHIPPED


def _seeds(key: str) -> list[int]:
    files = [path for root in roots() for path in (root / key).glob("seed*.safetensors")]
    return sorted({int(path.stem.removeprefix("seed")) for path in files})


def _variants(recipe: Recipe) -> Iterator[str]:
    """All recipes of this name in the zoo, with their seeds: `default (seeds 0, 1, 2)`, `victim.hidden=64 (seed 0)`."""
    keys = {path.name for root in roots() if root.is_dir() for path in root.iterdir()}
    for key in sorted(keys):
        if not re.fullmatch(f"{re.escape(recipe.name)}-[0-9a-f]{{{DIGITS}}}", key):
            continue
        cards = (root / key / f"seed{seed}.json" for seed in _seeds(key) for root in roots())
        if (path := next((path for path in cards if path.is_file()), None)) is None:
            continue
        numbers = ", ".join(map(str, _seeds(key)))
        yield f"{_differences(recipe, path)} (seed{'s' if len(_seeds(key)) > 1 else ''} {numbers})"


def _differences(recipe: Recipe, path: Path) -> str:
    """The differences between the entry of a card and the default, as text."""
    try:
        made = bounded.read_json(path, finite=False)["recipe"]
        differences = []
        for part in recipe.parts:
            trained = made[part.kind]
            differences += [f"{part.kind}.{name}={value}" for name, value in trained["changed"].items()]
            if trained["training"] != part.training:
                differences.append(f"training version {trained['training']} of {part.kind}, now {part.training}")
        return ", ".join(differences) or "default"
    except (UserError, KeyError, TypeError, AttributeError):
        return f"{path.parent.name} with a card that cannot be read"


def _provenance(parts: tuple[Part, ...]) -> dict[str, object]:
    """The versions of the code and libraries, the machine and the time."""
    modules = sorted({part.module for part in parts} - {"__main__"})
    return {
        "cavbench": metadata.version("cavbench"),
        "code": code_digest(tuple(modules)),
        "libraries": libraries(tuple(sorted({name for part in parts for name in part.libraries}))),
        "machine": machine(),
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
    }
