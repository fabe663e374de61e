"""The outline of a built-in component: its parameters, docstring and declarations, read from its source without importing it.

Importing a component imports torch, which takes seconds. An outline is a real dataclass with the same fields: whatever reads or
checks parameters takes it as it takes the component. It has none of the methods. Where a source is cleverer than declarations,
there is no outline, and the component itself must be imported. Sources of plug-ins are not evaluated.
"""

from __future__ import annotations

import ast
import builtins
import importlib
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import new_class
from typing import Any, ClassVar

from cavbench.core import registry
from cavbench.core.names import MARK
from cavbench.core.registry import GROUPS, OWN, Kind
from cavbench.identity.fingerprint import file_of

LIGHT = (
    "__future__",
    "abc",
    "annotated_types",
    "collections",
    "dataclasses",
    "enum",
    "functools",
    "math",
    "pathlib",
    "types",
    "typing",
    "cavbench.core",
    "cavbench.errors",
    "cavbench.scenarios",
)
"""Modules that are imported as they are: none of them needs torch."""
CLEVER = {"choices", "chosen", "__init__", "__new__", "__init_subclass__"}
"""Methods that make a component more than its declarations."""


CHECKS = {"slip"}
"""Methods that check values with nothing but the values, which an outline has, too."""


class UnclearError(Exception):
    """A source cannot be read as declarations."""


def outline(kind: Kind, name: str) -> type[Any] | None:
    """The outline of a built-in component; None if there is none.

    Args:
        kind: its kind.
        name: its name; chains, and the choices of adapters, have no outline.
    """
    claims = registry.entries(GROUPS[kind]).get(name, ())
    if len(claims) != 1 or claims[0].distribution != OWN or MARK in name or ":" in name:
        return None
    try:
        found = _resolved(*claims[0].target.split(":"))
    # A source may say anything.
    except Exception:
        return None
    return found if isinstance(found, type) else None


@cache
def _resolved(module: str, name: str) -> Any:
    """What a name of a module means: a class becomes its outline, other values are computed.

    Raises:
        UnclearError: if that cannot be told.
    """
    if any(f"{module}.".startswith(f"{light}.") for light in LIGHT):
        return getattr(importlib.import_module(module), name)
    definitions = _definitions(module)
    match definitions.get(name):
        case ast.ClassDef() as node:
            return _class(node, module)
        case ast.expr() as value:
            return _value(value, module)
        case (str(other), str(own)):
            return _resolved(other, own)
    raise UnclearError(f"{module}.{name}")


@cache
def _definitions(module: str) -> Mapping[str, Any]:
    """The classes, constants and imported names of a module."""
    path = file_of(module)
    if path is None or path.suffix != ".py":
        raise UnclearError(module)
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    found: dict[str, Any] = {}
    for node in _statements(ast.parse(path.read_bytes()).body):
        match node:
            case ast.ClassDef(name=name):
                found[name] = node
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                found[name] = value
            case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value):
                found[name] = value
            case ast.ImportFrom():
                base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
                found |= {alias.asname or alias.name: (base, alias.name) for alias in node.names}
    return found


def _statements(body: list[ast.stmt]) -> list[ast.stmt]:
    """The statements of a module, with those for types: a package may import these names when they are first used."""
    inner = [node.body for node in body if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"]
    return [*(node for part in inner for node in part), *body]


def _value(node: ast.expr, module: str) -> Any:
    """The value of an expression, from names that can be resolved."""
    names = {one.id for one in ast.walk(node) if isinstance(one, ast.Name)}
    known = {name: _resolved(module, name) for name in names if name in _definitions(module)}
    return eval(compile(ast.Expression(node), module, "eval"), {"__builtins__": vars(builtins)}, known)


def _class(node: ast.ClassDef, module: str) -> type[Any]:
    """The outline of a class."""
    bases = tuple(_base(base, module) for base in node.bases)
    bases = tuple(base for base in bases if base is not None) or (object,)
    if any(isinstance(line, ast.FunctionDef) and line.name in CLEVER for line in node.body):
        raise UnclearError(f"{module}.{node.name} is more than declarations")
    body: dict[str, Any] = {"__module__": module, "__annotations__": {}}
    if text := ast.get_docstring(node, clean=False):
        body["__doc__"] = text
    for line in node.body:
        match line:
            case ast.AnnAssign(target=ast.Name(id=name), annotation=hint, value=value) if _is_of_class(hint):
                # A field that overrides it keeps its place among the fields.
                body["__annotations__"][name] = ClassVar[Any]
                if value is not None:
                    body |= _if_clear(name, value, module)
            case ast.AnnAssign(target=ast.Name(id=name), annotation=hint, value=value):
                body["__annotations__"][name] = _value(hint, module)
                if value is not None:
                    body[name] = _value(value, module)
            case ast.FunctionDef(name=name) if name in CHECKS:
                exec(compile(ast.Module([line], []), module, "exec"), {"__builtins__": vars(builtins)}, body)
    made = new_class(node.name, bases, exec_body=lambda namespace: namespace.update(body))
    if any("dataclass" in ast.unparse(one) for one in node.decorator_list):
        made = dataclass(frozen=True, kw_only=True)(made)
    # It has no methods, and needs none.
    made.__abstractmethods__ = frozenset()  # type: ignore[attr-defined]
    return made


def _base(node: ast.expr, module: str) -> Any:
    """A base class; None for what says something of types alone."""
    if isinstance(node, ast.Subscript):
        node = node.value
    if isinstance(node, ast.Name) and node.id in ("ABC", "Generic", "Protocol"):
        return None
    return _value(node, module)


def _is_of_class(hint: ast.expr) -> bool:
    return ast.unparse(hint).startswith(("ClassVar", "typing.ClassVar"))


def _if_clear(name: str, node: ast.expr, module: str) -> dict[str, Any]:
    """A declaration, if it can be told; one that needs torch is left out."""
    try:
        return {name: _value(node, module)}
    # An expression may raise anything.
    except Exception:
        return {}
