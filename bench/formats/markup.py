"""Reads XML of strangers as a tree of elements, so that every reader finds the same in it.

A document type is refused, and with it every entity and every address that a reader might follow. Size, depth and number of
elements are limited. Namespaces and processing instructions mean nothing here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from xml.parsers import expat

from cavbench import bounded
from cavbench.errors import UserError, short

DEEPEST = 32
"""Most levels of elements."""
MOST_ELEMENTS = 1_000_000
"""Most elements: each takes some hundred bytes of memory."""
LARGEST = 1e9
"""Largest size of a number."""
NUMBER = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?", re.ASCII)
WHOLE = re.compile(r"[+-]?[0-9]{1,9}", re.ASCII)
SPACE = " \t\r\n"
"""White space of XML; Python's own has more."""


class Element:
    """An element of a document.

    Attributes:
        tag: its name.
        line: where it begins.
        attributes: its attributes.
        children: the elements in it.
        text: the text in it, before, between and after its children.
        whole: whether no comment or instruction divides its text, which readers join or cut.
    """

    __slots__ = ("attributes", "children", "line", "tag", "text", "whole")

    def __init__(self, tag: str, attributes: dict[str, str], line: int) -> None:
        self.tag, self.attributes, self.line = tag, attributes, line
        self.children: list[Element] = []
        self.text, self.whole = "", True

    def all(self, *tags: str) -> Iterator[Element]:
        """The children with one of these names."""
        return (child for child in self.children if child.tag in tags)

    def get(self, tag: str) -> Element | None:
        """The only child of a name, or None.

        Raises:
            ValueError: if there are several: readers differ on which one counts.
        """
        found = list(self.all(tag))
        if len(found) > 1:
            raise ValueError(f"line {found[1].line}: <{self.tag}> has <{tag}> twice")
        return found[0] if found else None

    def need(self, tag: str) -> Element:
        """The only child of a name.

        Raises:
            ValueError: if there is none, or several.
        """
        if (found := self.get(tag)) is None:
            raise ValueError(f"line {self.line}: <{self.tag}> has no <{tag}>")
        return found

    def attribute(self, name: str) -> str:
        """The value of an attribute.

        Raises:
            ValueError: if it is missing.
        """
        if name not in self.attributes:
            raise ValueError(f"line {self.line}: <{self.tag}> has no {name}")
        return self.attributes[name]

    def word(self) -> str:
        """Its text, which is all that it has.

        Raises:
            ValueError: if it has children, or a comment in its text.
        """
        if self.children or not self.whole:
            raise ValueError(f"line {self.line}: <{self.tag}> must be text alone")
        return self.text.strip(SPACE)

    def number(self) -> float:
        """Its text as a finite number.

        Raises:
            ValueError: if it is none.
        """
        return number(self.word(), f"line {self.line}: <{self.tag}>")

    def count(self) -> int:
        """Its text as a whole number.

        Raises:
            ValueError: if it is none.
        """
        return whole(self.word(), f"line {self.line}: <{self.tag}>")


def number(text: str, name: str) -> float:
    """A finite decimal number of at most `LARGEST`.

    Raises:
        ValueError: in one line that begins with `name`, if the text is none.
    """
    if NUMBER.fullmatch(text) is None or not math.isfinite(found := float(text)) or abs(found) > LARGEST:
        raise ValueError(f"{name} must be a finite number of at most {LARGEST:g}, got {short(text)!r}")
    return found


def whole(text: str, name: str) -> int:
    """A whole number of at most nine digits.

    Raises:
        ValueError: in one line that begins with `name`, if the text is none.
    """
    if WHOLE.fullmatch(text) is None:
        raise ValueError(f"{name} must be a whole number of at most nine digits, got {short(text)!r}")
    return int(text)


def read(path: Path, *, most: int = bounded.TEXT, name: str = "") -> Element:
    """The root of an XML file.

    Args:
        path: the file.
        most: largest size in bytes.
        name: the file in errors; its path if there is none.

    Raises:
        UserError: if it cannot be read, is larger, or `parsed` refuses it.
    """
    content = bounded.content(path, most=most, name=name)
    try:
        return parsed(content)
    except ValueError as error:
        raise UserError(f"{name or path} cannot be read: {error}") from None


def parsed(content: bytes) -> Element:
    """The root of an XML document.

    Raises:
        ValueError: in one line, if it is not well-formed, has a document type, or is larger than allowed.
    """
    tree = _Tree()
    try:
        tree.parser.Parse(content, True)
    except expat.ExpatError as error:
        raise ValueError(f"it is not XML: {error}") from None
    except LookupError:
        raise ValueError("it is not XML: its encoding is unknown") from None
    assert tree.root is not None
    return tree.root


class _Tree:
    """Builds the tree while expat reads."""

    def __init__(self) -> None:
        self.root: Element | None = None
        self.open: list[Element] = []
        self.elements = 0
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.StartDoctypeDeclHandler = self._refuse
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._text
        self.parser.CommentHandler = self._divide
        self.parser.ProcessingInstructionHandler = self._divide

    def _refuse(self, *declared: object) -> None:
        raise ValueError("it has a document type (<!DOCTYPE>), whose entities are not read: remove it")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self.elements += 1
        if self.elements > MOST_ELEMENTS:
            raise ValueError(f"it has more than {MOST_ELEMENTS} elements")
        if len(self.open) == DEEPEST:
            raise ValueError(f"it is nested deeper than {DEEPEST} levels")
        element = Element(tag, attributes, self.parser.CurrentLineNumber)
        if self.open:
            self.open[-1].children.append(element)
        else:
            self.root = element
        self.open.append(element)

    def _end(self, tag: str) -> None:
        self.open.pop()

    def _text(self, text: str) -> None:
        element = self.open[-1]
        # White space between elements is most of a file, and says nothing.
        if element.text or text.strip(SPACE):
            element.text += text

    def _divide(self, *inside: str) -> None:
        if self.open:
            self.open[-1].whole = False
