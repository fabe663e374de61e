"""XML of strangers: read as one tree by every reader, or refused in one line."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavbench.errors import UserError
from cavbench.formats import markup

NAMES = st.sampled_from(["a", "b", "point", "lane-let", "ß"])
TEXTS = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), max_size=8)
ENTITIES = '<!DOCTYPE a [<!ENTITY b "cc">]><a>&b;</a>'
LAUGHS = "<!DOCTYPE a [" + "".join(f'<!ENTITY e{n + 1} "{f"&e{n};" * 10}">' for n in range(9)) + "]><a>&e9;</a>"
OUTSIDE = '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>'
REMOTE = '<!DOCTYPE a SYSTEM "http://example.org/a.dtd"><a/>'


@st.composite
def trees(draw: st.DrawFn, depth: int = 3) -> ElementTree.Element:
    element = ElementTree.Element(draw(NAMES), draw(st.dictionaries(NAMES, TEXTS, max_size=2)))
    element.text = draw(TEXTS)
    if depth:
        for child in draw(st.lists(trees(depth=depth - 1), max_size=3)):
            element.append(child)
    return element


def same(found: markup.Element, wanted: ElementTree.Element) -> bool:
    text = wanted.text or ""
    return (
        found.tag == wanted.tag
        and found.attributes == wanted.attrib
        and (found.text.strip(markup.SPACE) == text.strip(markup.SPACE))
        and len(found.children) == len(wanted)
        and all(same(*pair) for pair in zip(found.children, wanted, strict=True))
    )


@given(trees())
def test_a_tree_is_read_as_elementtree_wrote_it(tree: ElementTree.Element) -> None:
    assert same(markup.parsed(ElementTree.tostring(tree, encoding="utf-8")), tree)


@given(st.floats(allow_nan=False, allow_infinity=False, min_value=-1e9, max_value=1e9))
def test_a_number_is_read_to_its_last_bit(value: float) -> None:
    assert markup.number(repr(value), "x") == value


@given(st.text(max_size=12))
def test_what_is_read_as_a_number_is_one_and_is_finite(text: str) -> None:
    try:
        found = markup.number(text, "x")
    except ValueError:
        return
    assert math.isfinite(found)
    assert text.isascii()
    assert not set(text) & set("_ ")


@pytest.mark.parametrize(
    "text", ["nan", "inf", "-Infinity", "1_000", "1e999", "1e10", "0x10", "١", " 1", "1\n", "", "."]
)
def test_what_python_takes_and_the_format_does_not_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="finite number"):
        markup.number(text, "x")


@pytest.mark.parametrize("text", [ENTITIES, LAUGHS, OUTSIDE, REMOTE, "<!DOCTYPE a><a/>"])
def test_a_document_type_is_refused_and_nothing_of_it_is_followed(text: str) -> None:
    with pytest.raises(ValueError, match="document type"):
        markup.parsed(text.encode())


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"<a>",
        b"<a></b>",
        b"<a/><b/>",
        b"\x00\xff",
        b"<a>&undefined;</a>",
        b"<a x='1' x='2'/>",
        b"<a>\x01</a>",
        b"<?xml version='1.0' encoding='no-such-code'?><a/>",
        "<a>é</a>".encode("latin-1"),
        b"PK\x03\x04",
    ],
)
def test_what_is_no_xml_is_one_line(content: bytes) -> None:
    with pytest.raises(ValueError, match="not XML") as raised:
        markup.parsed(content)
    assert "\n" not in str(raised.value)


def test_depth_and_number_of_elements_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    deep = markup.DEEPEST
    markup.parsed(b"<a>" * deep + b"</a>" * deep)
    with pytest.raises(ValueError, match="nested deeper"):
        markup.parsed(b"<a>" * (deep + 1) + b"</a>" * (deep + 1))
    with pytest.raises(ValueError, match="nested deeper"):
        markup.parsed(b"<a>" * 1_000_000)
    monkeypatch.setattr(markup, "MOST_ELEMENTS", 10)
    with pytest.raises(ValueError, match="more than 10 elements"):
        markup.parsed(b"<a>" + b"<b/>" * 10 + b"</a>")


def test_a_number_that_readers_cut_or_join_is_refused() -> None:
    for content in (b"<x>1<!-- -->2</x>", b"<x>1<?p?>2</x>", b"<x>1<y/></x>"):
        with pytest.raises(ValueError, match="text alone"):
            markup.parsed(content).number()


def test_a_child_that_stands_twice_is_refused() -> None:
    with pytest.raises(ValueError, match="twice"):
        markup.parsed(b"<p><x>1</x><x>2</x></p>").need("x")
    with pytest.raises(ValueError, match="has no <y>"):
        markup.parsed(b"<p><x>1</x></p>").need("y")


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    place = tmp_path / "large.xml"
    with place.open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(UserError, match="at most 16"):
        markup.read(place)


def test_a_file_is_named_in_what_is_said_of_it(tmp_path: Path) -> None:
    place = tmp_path / "scene.xml"
    place.write_text("<a>")
    with pytest.raises(UserError, match=r"scene\.xml cannot be read: it is not XML"):
        markup.read(place)
