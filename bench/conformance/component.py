"""The rules for every component: it is documented, can be set on the command line, and survives pickling."""

from __future__ import annotations

import pickle
from collections.abc import Mapping

from bench.conformance.check import BrokenRuleError, Check, Suite, one_line, require
from bench.errors import UserError
from bench.plugins import registry
from bench.plugins.fingerprint import canonical
from bench.plugins.options import configured
from bench.plugins.parameters import description, parameters


class ComponentSuite(Suite):
    """Of any kind and track."""

    def checks(self) -> Mapping[str, Check]:
        return {
            "docs": self.documented,
            "command line": self.set_by_words,
            "worker processes": self.picklable,
            "version": self.versioned,
        }

    def documented(self) -> None:
        """`bench list NAME` shows its docstrings."""
        kind = type(self.component)
        require(description(kind), f"{kind.__name__} has no docstring: say what it does in a sentence")
        silent = [parameter.name for parameter in parameters(kind).values() if not parameter.meaning]
        require(not silent, f"say in the docstring's `Args:` what these mean: {', '.join(silent)}")

    def set_by_words(self) -> str:
        """Every parameter can be written on the command line and comes back as it was."""
        owned = parameters(type(self.component))
        written = {name: text for name in owned if (text := _text(getattr(self.component, name))) is not None}
        try:
            made = configured(self.subject.kind, self.subject.name, written).component
        except UserError as error:
            hint = "types may be bool, int, float, str, Literal, None and tuples of them"
            raise BrokenRuleError(f"{one_line(error)} ({hint})") from None
        for name, text in written.items():
            value, wanted = getattr(made, name), getattr(self.component, name)
            require(
                type(value) is type(wanted) and value == wanted,
                f"{self.subject.kind}.{name}={text} is read as {value!r}: its type annotation does not fit its value {wanted!r}",
            )
        return f"{len(written)} of {len(owned)} parameters" if len(written) < len(owned) else ""

    def picklable(self) -> None:
        """Worker processes get it pickled."""
        try:
            copy = pickle.loads(pickle.dumps(self.component))
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            require(False, f"keep plain values in its fields, and make the rest where it is used: {one_line(error)}")
        require(copy == self.component, "a pickled copy is not equal: give its fields types that compare by value")
        require(
            canonical(copy) == canonical(self.component),
            "a pickled copy has another fingerprint: a field is written with its address in memory",
        )

    def versioned(self) -> str:
        """Records name the package and its version."""
        shipped_by = registry.find(registry.GROUPS[self.subject.kind], self.subject.name, self.subject.kind).shipped_by
        require("unknown" not in shipped_by, "its package has no version: install it with pip")
        return f"records say {shipped_by}"


def _text(value: object) -> str | None:
    """A value as it is written on the command line; None for those that cannot be."""
    match value:
        case bool():
            return str(value).lower()
        case None:
            return "null"
        case tuple() | list():
            texts = [_text(item) for item in value]
            return None if None in texts else f"[{','.join(filter(None, texts))}]"
        case str():
            quoted = value.replace("\\", "\\\\").replace('"', '\\"')
            return f'"{quoted}"'
        case _:
            return str(value)
