"""Hashes of everything that a result depends on: configuration, source code, library versions."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import json
import os
import platform
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

LIBRARIES = ("torch", "torchrl", "tensordict", "numba", "numpy")

OWN = "cavbench"
PARTS = ("attacks", "defenses", "envs", "leaderboard")
"""Packages in `cavbench` that stand beside its folder in a checkout."""
BESIDE_THE_RESULT = (
    *("api", "bounded", "checks", "cli", "core", "errors", "exports", "files", "identity", "leaderboard", "recording"),
    *("records", "run", "statistics", "terminal"),
    *("driving.checks", "driving.recording", "driving.track", "driving.trial"),
    *("detection.checks", "detection.recording", "detection.track", "detection.trial"),
    *("isolation.custody", "isolation.foreign", "isolation.framework", "isolation.held", "isolation.memory"),
    *("isolation.settings", "isolation.threads"),
)
"""Packages and modules of `cavbench` that choose, store or show results: editing them outdates no record."""


STATEMENTS = (ast.stmt, ast.excepthandler, ast.match_case)
"""The nodes of a syntax tree that can hold an import. Most nodes of a file are expressions, which cannot."""


def canonical(value: Any) -> str:
    """The canonical JSON of a value: sorted keys, no spaces; dataclasses and mappings as objects, anything else by str().

    What was made from a parameter (`as_given`) is written as the parameter. A mapping whose class is `ordered` keeps its order.
    """
    return json.dumps(_plain(value), separators=(",", ":"), default=str)


def _plain(value: Any) -> Any:
    """The same of dicts with sorted keys, lists, and what `json` writes as it is."""
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if (given := as_given(value)) is not value:
        return _plain(given)
    if is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Mapping):
        items = value.items() if getattr(type(value), "ordered", False) else sorted(value.items())
        return {name: _plain(each) for name, each in items}
    return str(value)


def as_given(value: Any) -> Any:
    """The parameter that a value was made from, if it says so (`given_parameter`); otherwise the value itself.

    A component may turn a parameter into an object that it computes with, such as axes from a mapping of values.
    """
    return value.given_parameter if hasattr(type(value), "given_parameter") else value


def digest(value: Any) -> str:
    """sha256 of the canonical JSON, in hexadecimal."""
    return hashlib.sha256(canonical(value).encode()).hexdigest()


@cache
def code_digest(modules: tuple[str, ...]) -> str:
    """sha256 of the names and the code of `sources(modules)`, without comments, docstrings and layout."""
    return told().get(modules) or digest({name: _code(path) for name, path in sources(modules).items()})


@cache
def told() -> dict[tuple[str, ...], str]:
    """Code digests that a worker was told by its parent, on the same machine: parsing the sources takes half a second."""
    return {}


def _code(path: Path) -> str:
    """sha256 of the syntax tree of a file, without docstrings."""
    return _parsed(path)[0]


Import = ast.Import | ast.ImportFrom


@cache
def _parsed(path: Path) -> tuple[str, tuple[Import, ...]]:
    """sha256 of the syntax tree of a file, without docstrings; and its imports. Parsing a file takes as long as importing it."""
    tree = ast.parse(path.read_bytes())
    imports = tuple(_imports_of(tree, path))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [kept for kept in node.body if not _is_text(kept)] or [ast.Pass()]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest(), imports


def _imports_of(tree: ast.AST, path: Path) -> Iterator[Import]:
    """The import statements of a file, but for those of types alone."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        # What types alone need is never executed; a package may import it when it is first used (`cavbench.exports`).
        for_types = isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        skipped = for_types and path.name != "__init__.py"
        inside = node.orelse if skipped and isinstance(node, ast.If) else ast.iter_child_nodes(node)
        waiting += [child for child in inside if isinstance(child, STATEMENTS)]
        if isinstance(node, Import):
            yield node


def _is_text(node: ast.stmt) -> bool:
    """Whether a statement is a docstring of a definition or of an attribute."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def sources(modules: Iterable[str]) -> dict[str, Path]:
    """The source files of modules and of everything they import, directly or indirectly, anywhere in their code but for
    types alone (`if TYPE_CHECKING`).

    Imports are followed within the modules' top-level packages and `cavbench`, except `BESIDE_THE_RESULT`; of other packages only
    the version counts.
    """
    waiting = list(modules)
    packages = {OWN, *(name.partition(".")[0] for name in waiting)}
    found: dict[str, Path] = {}
    while waiting:
        name = waiting.pop()
        path = file_of(name)
        if path is None or name in found or _is_beside(name):
            continue
        found[name] = path
        imported = (*_imports(name, path), name.rpartition(".")[0])
        waiting += [other for other in imported if other.partition(".")[0] in packages]
    return found


def _is_beside(module: str) -> bool:
    """Whether no result depends on a module; the package `cavbench` itself is the door to all of them."""
    package, _, inner = module.partition(".")
    return package == OWN and (not inner or any(f"{inner}.".startswith(f"{beside}.") for beside in BESIDE_THE_RESULT))


def file_of(module: str) -> Path | None:
    """The file of a module, found without importing it or its parents, but `cavbench`; None if there is no such module."""
    top, *inner = module.split(".")
    if top == OWN and inner and inner[0] in PARTS:
        top, inner = f"{top}.{inner[0]}", inner[1:]
    spec = importlib.util.find_spec(top)
    if spec is None:
        return None
    if spec.submodule_search_locations is None:
        return Path(spec.origin) if spec.origin and not inner else None
    candidates = (
        path
        for root in spec.submodule_search_locations
        for path in (Path(root, *inner, "__init__.py"), Path(root, *inner).with_suffix(".py"))
    )
    return next((path for path in candidates if path.is_file()), None)


@cache
def _imports(module: str, path: Path) -> tuple[str, ...]:
    """Every name in the import statements of a module, whether it names a module or not."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    found: list[str] = []
    for node in _parsed(path)[1]:
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        else:
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            found += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return tuple(found)


def state_digest(network: Any) -> str:
    """sha256 of a torch module's weights and buffers: names, types, shapes and values."""
    hasher = hashlib.sha256()
    for name, value in sorted(network.state_dict().items()):
        hasher.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        hasher.update(value.detach().cpu().contiguous().numpy().tobytes())
    return hasher.hexdigest()


@cache
def libraries(more: tuple[str, ...] = ()) -> dict[str, str]:
    """Versions of Python, of the libraries that compute results, and of `more` distributions."""
    return {"python": platform.python_version(), **{name: metadata.version(name) for name in (*LIBRARIES, *more)}}


@cache
def machine() -> str:
    """System, processor and number of cores, as far as Python knows them."""
    return f"{platform.system()} {platform.machine()} {_processor()}, {os.cpu_count()} cores"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
