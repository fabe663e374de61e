"""The sets of a threat model beside the perturbation of values, as text: `relative+presence.hidden=1+latency.frames=2`.

A set is a frozen dataclass with a default for every field. The defaults are the empty set: the attacker may do nothing of it.
A threat model may also have *marks*, text fields such as `knows`: where one is off its default, `patch+knows=site`.
"""

from __future__ import annotations

import re
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Annotated, Any, get_args, get_origin

WRITTEN = re.compile(r"[a-z0-9_]+(\+[a-z_]+=[a-z_]+|\+[a-z_]+\.[a-z_]+=-?[0-9][0-9.e+-]*)*")
"""A perturbation set with the others, as records have it in `threat_norm`."""


def of(model: type[Any]) -> Mapping[str, type[Any]]:
    """The classes of the sets of a threat model, by name of the field."""
    hints = typing.get_type_hints(model)
    return {item.name: hints[item.name] for item in fields(model) if is_dataclass(hints[item.name])}


def present(threat: Any) -> dict[str, Any]:
    """The sets of a threat model that are not empty, by name."""
    found = {name: getattr(threat, name) for name in of(type(threat))}
    return {name: value for name, value in found.items() if value != type(value)()}


def made(name: str, kind: type[Any], given: Any) -> Any:
    """A set from a mapping of its fields, or the set itself.

    Raises:
        ValueError: if a field is unknown, or a value is not allowed; the message begins with the key on the command line.
    """
    if isinstance(given, kind):
        return given
    if not isinstance(given, Mapping):
        raise ValueError(f"{name} takes {', '.join(f'{name}.{item.name}' for item in fields(kind))}, got {given!r}")
    known = _types(kind)
    for key, value in given.items():
        if key not in known:
            raise ValueError(f"{name}.{key} is unknown: {name} has {', '.join(known)}")
        if known[key] is int and (isinstance(value, bool) or not isinstance(value, int)):
            raise ValueError(f"{name}.{key} must be a whole number, got {value!r}")
    try:
        return kind(**given)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name}.{error}") from None


def allows(threat: Any, word: str) -> bool:
    """Whether a threat model allows something in a field of a set: a `word` such as `presence.hidden=1`, whatever its number.

    A mark, such as `shape=plate`, must have this value.
    """
    key, _, value = word.partition("=")
    if key in threat.marks:
        return bool(getattr(threat, key) == value)
    name, _, field = word.partition("=")[0].partition(".")
    return field in changed(getattr(threat, name, None)) if name in of(type(threat)) else False


def words(threat: Any) -> list[str]:
    """What a threat model allows beside its perturbation set: `presence.hidden=1`, one text for each field off its default."""
    marks = [f"{name}={value}" for name, value in marked(threat).items()]
    return marks + [
        f"{name}.{key}={_number(value)}" for name, one in present(threat).items() for key, value in changed(one).items()
    ]


def marked(threat: Any) -> dict[str, str]:
    """The marks of a threat model that are off their defaults, by name."""
    defaults = {item.name: item.default for item in fields(threat)}
    return {name: getattr(threat, name) for name in threat.marks if getattr(threat, name) != defaults[name]}


def split(text: str) -> tuple[str, list[str]]:
    """The perturbation set and the `words` in a `threat_norm` of a record.

    Raises:
        ValueError: if it is not such a text.
    """
    if not WRITTEN.fullmatch(text):
        raise ValueError(f"{text[:80]!r} is no perturbation set with other sets")
    # A number may have a plus sign in its exponent.
    norm, *rest = re.split(r"\+(?=[a-z_]+[.=])", text)
    return norm, rest


def read(model: type[Any], given: list[str]) -> dict[str, Any]:
    """The sets and marks in `words`, as arguments of the threat model.

    Raises:
        ValueError: if the threat model has no such set or field.
    """
    found: dict[str, Any] = {}
    for word in given:
        key, _, text = word.partition("=")
        name, _, field = key.partition(".")
        if key in model.marks:
            found[key] = text
            continue
        if name not in of(model) or field not in _types(of(model)[name]):
            raise ValueError(f"threat.{key} is unknown")
        whole = _types(of(model)[name])[field] is int
        found.setdefault(name, {})[field] = int(text) if whole else float(text)
    return found


def widened(threat: Any, given: Mapping[str, float]) -> Any:
    """The threat model with other values in fields of its sets, by names such as `dynamics.time_gap`.

    Raises:
        ValueError: if it has no such field, or the value is not allowed.
    """
    known = of(type(threat))
    for key, value in given.items():
        name, _, field = key.partition(".")
        if name not in known or field not in _types(known[name]):
            raise ValueError(f"threat.{key} is unknown")
        threat = replace(threat, **{name: replace(getattr(threat, name), **{field: value})})
    return threat


def changed(one: Any) -> dict[str, Any]:
    """The fields of a set that are off their defaults."""
    return {item.name: getattr(one, item.name) for item in fields(one) if getattr(one, item.name) != item.default}


def _types(kind: type[Any]) -> Mapping[str, type[Any]]:
    """The type of each field, without its range."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {item.name: _plain(hints[item.name]) for item in fields(kind)}


def _plain(hint: Any) -> Any:
    return _plain(get_args(hint)[0]) if get_origin(hint) is Annotated else hint


def _number(value: float) -> str:
    short = f"{value:g}"
    return short if float(short) == value else repr(value)
