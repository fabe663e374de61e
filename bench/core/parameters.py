"""The parameters of a component: its dataclass fields with types, choices, and meanings from its docstring."""

from __future__ import annotations

import inspect
import re
import types
import typing
from dataclasses import MISSING, Field, dataclass, fields
from functools import cache
from typing import Any, Literal, Union, get_args, get_origin

from cavbench.core import ranges
from cavbench.core.contracts import Component
from cavbench.errors import PluginError
from cavbench.identity.fingerprint import as_given


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One parameter of a component.

    Args:
        name: name of the dataclass field.
        hint: its type.
        default: default value; None if `required`.
        required: whether it must be given.
        meaning: description in the Args of the class docstring; empty if there is none.
        allowed: choices or range as text; empty if only the type restricts it.
    """

    name: str
    hint: Any
    default: Any
    required: bool
    meaning: str
    allowed: str = ""

    @property
    def choices(self) -> tuple[Any, ...]:
        """The allowed values of a Literal type; empty for other types."""
        hints = (self.hint, *get_args(self.hint)) if get_origin(self.hint) in (Union, types.UnionType) else (self.hint,)
        return tuple(choice for hint in hints if get_origin(hint) is Literal for choice in get_args(hint))

    @property
    def default_text(self) -> str:
        """The default as text, or "required"."""
        if self.required:
            return "required"
        return str(self.default).lower() if isinstance(self.default, bool) else str(self.default)

    @property
    def type_name(self) -> str:
        """The type as written in the source."""
        if self.choices:
            return type(self.choices[0]).__name__
        return self.hint.__name__ if isinstance(self.hint, type) and not get_args(self.hint) else str(self.hint)


def parameters(component: type) -> dict[str, Parameter]:
    """The parameters of a component class, in order.

    Raises:
        PluginError: if a type annotation cannot be read at run time.
    """
    kind: Any = component
    return dict(_declared(kind))


@cache
def _declared(component: type) -> dict[str, Parameter]:
    try:
        hints, annotated = (typing.get_type_hints(component, include_extras=extras) for extras in (False, True))
    # Annotations are evaluated, and may be any expression.
    except Exception as error:
        raise PluginError(f"the parameters of {component.__qualname__} cannot be read: {error}") from error
    meanings: dict[str, str] = {}
    for base in reversed(component.__mro__):
        meanings |= _meanings(base)
    return {
        field.name: Parameter(
            name=field.name,
            hint=hints[field.name],
            default=_default(field),
            required=field.default is MISSING and field.default_factory is MISSING,
            meaning=meanings.get(field.name, ""),
            allowed=ranges.words(annotated[field.name]),
        )
        for field in fields(component)
        if field.init
    }


def flattened(component: type) -> dict[str, Parameter]:
    """The parameters of a component class by name; those of the links of a chain as `LINK.NAME`."""
    found: dict[str, Parameter] = {}
    for name, parameter in parameters(component).items():
        if isinstance(parameter.hint, type) and issubclass(parameter.hint, Component):
            found |= {f"{name}.{inner}": each for inner, each in flattened(parameter.hint).items()}
        else:
            found[name] = parameter
    return found


def differing(component: Any) -> dict[str, Any]:
    """The parameters of a component that differ from their defaults; those of the links of a chain as `LINK.NAME`."""
    found: dict[str, Any] = {}
    for name, parameter in parameters(type(component)).items():
        value = as_given(getattr(component, name))
        if isinstance(value, Component):
            found |= {f"{name}.{inner}": each for inner, each in differing(value).items()}
        elif parameter.required or value != parameter.default:
            found[name] = value
    return found


def description(component: type) -> str:
    """The class docstring without its Args; empty if the class itself has none."""
    return re.sub(r"\n*Args:\n(?:[ \t]+.*\n?|\n(?=[ \t]))*", "\n", _docstring(component)).strip()


def _default(field: Field[Any]) -> Any:
    if field.default_factory is not MISSING:
        return field.default_factory()
    return None if field.default is MISSING else field.default


def _docstring(component: type) -> str:
    text = component.__dict__.get("__doc__") or ""
    # dataclass() sets the signature as the docstring of a class without one.
    return "" if text.startswith(f"{component.__name__}(") else inspect.cleandoc(text)


def _meanings(component: type) -> dict[str, str]:
    """The meanings of all parameters: those of a base class stand in its docstring, unless the class says them itself."""
    found: dict[str, str] = {}
    for parent in reversed(component.__mro__):
        found |= _args(parent)
    return found


def _args(component: type) -> dict[str, str]:
    """The Args of a Google-style docstring: `name: meaning` or `name, name: meaning`, continued on indented lines."""
    _, _, section = _docstring(component).partition("Args:\n")
    found: dict[str, str] = {}
    current: list[str] = []
    for line in section.splitlines():
        if line and not line.startswith(" "):
            break
        if match := re.match(r" {1,4}(\w+(?:, \w+)*): (.*)", line):
            current = match[1].split(", ")
            found |= dict.fromkeys(current, match[2])
        elif line.strip():
            found |= {name: f"{found[name]} {line.strip()}" for name in current}
    return found
