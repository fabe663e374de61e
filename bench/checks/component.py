"""Rules for all components: they are documented, can be set on the command line, and survive pickling."""

from __future__ import annotations

import pickle
from collections.abc import Mapping

from cavbench.checks.check import BrokenRuleError, Check, Suite, one_line, require
from cavbench.core import registry
from cavbench.core.options import configured
from cavbench.core.parameters import description, parameters
from cavbench.errors import UserError
from cavbench.identity.fingerprint import as_given, canonical


class ComponentSuite(Suite):
    """Checks of a component of any kind and track."""

    def checks(self) -> Mapping[str, Check]:
        return {
            "docs": self.documented,
            "command line": self.set_by_words,
            "worker processes": self.picklable,
            "version": self.versioned,
        }

    def documented(self) -> None:
        """It has the docstrings that `bench list NAME` shows."""
        kind = type(self.component)
        require(description(kind), f"{kind.__name__} has no docstring: describe it in one sentence")
        silent = [parameter.name for parameter in parameters(kind).values() if not parameter.meaning]
        require(not silent, f"describe these parameters in the docstring's `Args:`: {', '.join(silent)}")

    def set_by_words(self) -> str:
        """Every parameter can be written on the command line, and is parsed to the same value."""
        owned = parameters(type(self.component))
        given = {name: as_given(getattr(self.component, name)) for name in owned}
        written = {name: text for name, value in given.items() if (text := _text(value)) is not None}
        try:
            made = configured(self.subject.kind, self.subject.name, written).component
        except UserError as error:
            hint = "types may be bool, int, float, str, Literal, None and tuples of them"
            raise BrokenRuleError(f"{one_line(error)} ({hint})") from None
        for name, text in written.items():
            value, wanted = as_given(getattr(made, name)), given[name]
            require(
                type(value) is type(wanted) and value == wanted,
                f"{self.subject.kind}.{name}={text} is parsed as {value!r}: its annotation does not fit its value {wanted!r}",
            )
        return f"{len(written)} of {len(owned)} parameters" if len(written) < len(owned) else ""

    def picklable(self) -> None:
        """It survives pickling, by which worker processes receive it."""
        try:
            copy = pickle.loads(pickle.dumps(self.component))
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            require(
                False,
                f"keep only plain values in its fields, and create other objects where they are used: {one_line(error)}",
            )
        require(copy == self.component, "a pickled copy is not equal: use field types that compare by value")
        require(
            canonical(copy) == canonical(self.component),
            "a pickled copy has another fingerprint: the text of a field contains its memory address",
        )

    def versioned(self) -> str:
        """Its package has a version, which records name."""
        shipped_by = registry.find(registry.GROUPS[self.subject.kind], self.subject.name, self.subject.kind).shipped_by
        require("unknown" not in shipped_by, "its package has no version: install it with pip")
        return f"records name {shipped_by}"


def _text(value: object) -> str | None:
    """A value as written on the command line; None if it cannot be written."""
    match value:
        case bool():
            return str(value).lower()
        case None:
            return "null"
        case tuple() | list():
            texts = [_text(item) for item in value]
            return None if None in texts else f"[{','.join(filter(None, texts))}]"
        case Mapping():
            texts = [_text(item) for item in value.values()]
            return (
                None
                if None in texts
                else "{" + ",".join(f"{name}:{text}" for name, text in zip(value, texts, strict=True)) + "}"
            )
        case str():
            quoted = value.replace("\\", "\\\\").replace('"', '\\"')
            return f'"{quoted}"'
        case _:
            return str(value)
