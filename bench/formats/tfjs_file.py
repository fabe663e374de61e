"""Reads a graph of TensorFlow.js (`model.json` and the files of its weights) as data: nodes with their operations, and tensors.

Format: `tfjs_graph_model` of tensorflowjs_converter. The JSON lists the nodes of a TensorFlow graph and, in a manifest, names,
shapes and types of the weights, which lie one after the other in the files beside it.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cavbench import bounded
from cavbench.errors import UserError, short
from cavbench.formats.trial import RefusedError

LARGEST = 2**30
"""Most bytes of the weights together."""
MOST_NODES = 20_000
DEEPEST_SHAPE = 6
TYPES = {"float32": "<f4", "int32": "<i4", "bool": "u1", "uint8": "u1"}
"""Types of weights that are read, as they lie in a file if they are not quantised."""
QUANTISED = {"float16": "<f2", "uint8": "u1", "uint16": "<u2"}


@dataclass(frozen=True)
class Node:
    """A node of the graph: its operation, the values that it takes, each a node and the number of its result, and attributes."""

    name: str
    operation: str
    inputs: tuple[tuple[str, int], ...]
    attributes: Mapping[str, Any]


@dataclass(frozen=True)
class GraphFile:
    """What a file holds.

    Args:
        nodes: by name, each after those that it takes values of.
        weights: tensors by the names of their nodes.
        outputs: the values that the graph returns.
        sha256: hash of the JSON and of all weights.
    """

    nodes: Mapping[str, Node]
    weights: Mapping[str, Tensor]
    outputs: tuple[tuple[str, int], ...]
    sha256: str


def read(path: Path, name: str) -> GraphFile:
    """Read a graph.

    Args:
        path: `model.json`.
        name: its name in errors.

    Raises:
        UserError: if it is not such a graph, or its weights are missing, of other sizes, or elsewhere than in its folder.
    """
    found = bounded.read_json(path, name=name)
    try:
        if found.get("format") == "layers-model" or "node" not in found["modelTopology"]:
            raise RefusedError(
                "it is a layers model: write a graph with tensorflowjs_converter --output_format=tfjs_graph_model"
            )
        weights, sha256 = _weights(found["weightsManifest"], path)
        nodes = _in_order(_nodes(found["modelTopology"]))
        return GraphFile(nodes, weights, _outputs(found, nodes), sha256)
    except RefusedError as error:
        raise UserError(f"{name} is refused: {error}") from error
    # Any part of the JSON may be missing or of another type.
    except (KeyError, ValueError, TypeError, AttributeError, IndexError, OverflowError) as error:
        raise UserError(f"{name} cannot be read: it is not a graph of TensorFlow.js, or a damaged one") from error


def _weights(manifest: Sequence[Mapping[str, Any]], path: Path) -> tuple[dict[str, Tensor], str]:
    """The tensors of a manifest, and a hash of the JSON and of the files."""
    tensors: dict[str, Tensor] = {}
    hasher, left = hashlib.sha256(bounded.content(path, most=bounded.TEXT)), LARGEST
    for group in manifest:
        content = bytearray()
        for part in group["paths"]:
            content += _beside(part, path, left - len(content))
        left -= len(content)
        hasher.update(hashlib.sha256(content).digest())
        place = 0
        for entry in group["weights"]:
            if entry["name"] in tensors:
                raise RefusedError(f"it has the weight {short(str(entry['name']))!r} twice")
            place, tensors[entry["name"]] = _tensor(entry, content, place)
        if place != len(content):
            raise RefusedError(f"its weights take {place} bytes, and their files have {len(content)}")
    return tensors, hasher.hexdigest()


def _beside(part: str, path: Path, most: int) -> bytes:
    """The content of a file of weights, which lies in the folder of the JSON."""
    file = path.parent / part
    if not part or "/" in part or "\\" in part or "\0" in part or part in (".", "..") or file.is_symlink():
        raise RefusedError(f"it reads {short(part)!r}; a graph may read files in its own folder only")
    if not file.is_file():
        raise UserError(f"{path} cannot be read: it needs the file {short(part)} beside it")
    return bounded.content(file, most=max(most, 0), links=False)


def _tensor(entry: Mapping[str, Any], content: bytearray, place: int) -> tuple[int, Tensor]:
    """Where the next tensor begins, and this one."""
    name, shape = short(str(entry["name"])), entry["shape"]
    if len(shape) > DEEPEST_SHAPE or not all(type(side) is int and 0 <= side < 2**31 for side in shape):
        raise RefusedError(f"its weight {name!r} has the shape {short(str(shape))}")
    quantised = entry.get("quantization") or {}
    kind = quantised.get("dtype", entry["dtype"])
    known = QUANTISED if quantised else TYPES
    if kind not in known or entry["dtype"] not in TYPES:
        raise RefusedError(f"its weight {name!r} has the type {short(str(kind))!r}, which is not read")
    dtype, count = np.dtype(known[kind]), math.prod(shape)
    end = place + count * dtype.itemsize
    if end > len(content):
        raise RefusedError(f"its weight {name!r} ends at byte {end}, and the file has {len(content)}")
    values = np.frombuffer(content, dtype, count, place)
    if quantised and kind != "float16":
        scale, least = float(quantised["scale"]), float(quantised["min"])
        values = (
            (values.astype(np.float64) * scale + least).round() if entry["dtype"] == "int32" else values * scale + least
        )
    whole = entry["dtype"] == "int32"
    made = values.astype(
        bool if entry["dtype"] == "bool" else np.int64 if whole or entry["dtype"] == "uint8" else np.float32
    )
    return end, torch.from_numpy(made.copy()).reshape(shape)


def _nodes(topology: Mapping[str, Any]) -> dict[str, Node]:
    if len(topology["node"]) > MOST_NODES:
        raise RefusedError(f"it has {len(topology['node'])} nodes, at most {MOST_NODES} are allowed")
    if (topology.get("library") or {}).get("function"):
        raise RefusedError("it has functions, as loops and conditions do; only plain graphs are read")
    nodes = {}
    for node in topology["node"]:
        name, operation = str(node["name"]), str(node["op"])
        if name in nodes:
            raise RefusedError(f"it has the node {short(name)!r} twice")
        inputs = tuple(value(one) for one in node.get("input", ()) if not one.startswith("^"))
        nodes[name] = Node(name, operation, inputs, dict(node.get("attr") or {}))
    return nodes


def value(text: str) -> tuple[str, int]:
    """A value: `name`, or `name:2` for the third result of a node."""
    name, mark, number = text.rpartition(":")
    return (name, int(number)) if mark and number.isdecimal() and len(number) < 6 else (text, 0)


def _in_order(nodes: Mapping[str, Node]) -> dict[str, Node]:
    """Each node after those that it takes values of; without recursion, which a deep graph would exhaust.

    Raises:
        RefusedError: if a node takes a value of no node, or of itself by others.
    """
    waits = {name: len(node.inputs) for name, node in nodes.items()}
    followers: dict[str, list[str]] = {name: [] for name in nodes}
    for name, node in nodes.items():
        for other, _ in node.inputs:
            if other not in nodes:
                raise RefusedError(f"its node {short(name)!r} takes {short(other)!r}, which it does not have")
            followers[other].append(name)
    ready = [name for name, count in waits.items() if not count]
    for name in ready:
        for follower in followers[name]:
            waits[follower] -= 1
            if not waits[follower]:
                ready.append(follower)
    if len(ready) < len(nodes):
        raise RefusedError("its nodes form a circle")
    return {name: nodes[name] for name in ready}


def _outputs(found: Mapping[str, Any], nodes: Mapping[str, Node]) -> tuple[tuple[str, int], ...]:
    """Those of the signature, in its order; without one, the values that no node takes."""
    signature = found.get("signature") or (found.get("userDefinedMetadata") or {}).get("signature") or {}
    stated = [value(str(one["name"])) for one in (signature.get("outputs") or {}).values()]
    if not stated:
        taken = {name for node in nodes.values() for name, _ in node.inputs}
        stated = [(name, 0) for name, node in nodes.items() if name not in taken and node.operation != "NoOp"]
    for name, _ in stated:
        if name not in nodes:
            raise RefusedError(f"it returns {short(name)!r}, which it does not have")
    return tuple(stated)


def texts(attribute: Mapping[str, Any] | None) -> list[str]:
    """The text of an attribute, or its texts if it is a list; in base64, as TensorFlow.js writes them."""
    if attribute is None:
        return []
    return list(_decoded(attribute["list"].get("s", ()) if "list" in attribute else [attribute["s"]]))


def _decoded(words: Sequence[str]) -> Iterator[str]:
    for word in words:
        try:
            yield base64.b64decode(word, validate=True).decode("ascii")
        except (binascii.Error, UnicodeDecodeError) as error:
            raise RefusedError(f"it has the text {short(str(word))!r}, which is not base64") from error


def whole(attribute: Mapping[str, Any] | None, otherwise: int = 0) -> int:
    """The whole number of an attribute."""
    return otherwise if attribute is None else int(attribute["i"])


def wholes(attribute: Mapping[str, Any] | None) -> list[int]:
    """The whole numbers of an attribute that is a list."""
    return [int(one) for one in ((attribute or {}).get("list") or {}).get("i") or ()]


def number(attribute: Mapping[str, Any] | None, otherwise: float) -> float:
    """The number of an attribute."""
    return otherwise if attribute is None else float(attribute["f"])


def yes(attribute: Mapping[str, Any] | None) -> bool:
    """Whether an attribute is true."""
    return attribute is not None and attribute.get("b") is True
