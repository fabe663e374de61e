"""Strategies of Hypothesis that change valid files: their bytes, or the structure of JSON, zip, ONNX, Parquet and the like."""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from collections.abc import Callable, Iterator, MutableMapping, MutableSequence
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from hypothesis import strategies as st

from tests.soak import bad_inputs

Draw = Callable[[st.SearchStrategy[Any]], Any]
Change = Callable[[bytes], st.SearchStrategy[bytes]]

NUMBERS = (0, 1, 2, 7, 127, 128, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)
HOSTILE = ("", "\0", "../../x", "/etc/hostname", "a" * 5000, "\x1b[2J", "\u202e", "__class__", "os.system", "a\nb", "é")
"""Texts in place of names."""
JSON = (
    *(
        "null",
        "true",
        "-1",
        "0",
        "1",
        "3",
        "1.5",
        "NaN",
        "Infinity",
        "-Infinity",
        "1e999",
        "1e-999",
        "9" * 30,
        "9" * 5000,
    ),
    *(
        '""',
        '"nan"',
        '"inf"',
        '"1e999"',
        '"\\ud800"',
        '"\\u0000"',
        "[]",
        "{}",
        "[0]",
        '{"a": 0}',
        "[[1], [2]]",
        "[-1, -1]",
    ),
    *("[" * 100 + "]" * 100, "[" * 100_000 + "]" * 100_000, '{"a":' * 2000 + "0" + "}" * 2000, "[1e308, 1e308]"),
    *('1, "doubled": 2, "doubled": 3', "4294967296", "9223372036854775807", "18446744073709551616", "1099511627776"),
)
"""Texts in place of JSON values."""
WORDS = (
    *bad_inputs.NUMBERS,
    *bad_inputs.NESTED,
    *bad_inputs.HOSTILE,
    *bad_inputs.NAMES,
    *bad_inputs.KEYS,
    *HOSTILE[2:],
)
HOLE = "@hole@"


@st.composite
def damaged(draw: Draw, content: bytes) -> bytes:
    """Bytes with one to three changes: something is replaced, cut, put in, repeated, or a number is another."""
    for _ in range(draw(st.integers(1, 3))):
        content = _edited(draw, content)
    return content


def _edited(draw: Draw, content: bytes) -> bytes:
    size = len(content)
    # Formats keep what matters at their ends.
    place = draw(st.one_of(st.integers(0, min(size, 80)), st.integers(max(size - 300, 0), size), st.integers(0, size)))
    before, after = content[:place], content[place:]
    match draw(st.sampled_from(("bit", "byte", "number", "end", "cut", "put", "again", "elsewhere"))):
        case "bit" if after:
            return before + bytes([after[0] ^ 1 << draw(st.integers(0, 7))]) + after[1:]
        case "byte":
            new = draw(st.binary(min_size=1, max_size=8))
            return before + new + after[len(new) :]
        case "number":
            width, order = draw(st.sampled_from((1, 2, 4, 8))), draw(st.sampled_from(("little", "big")))
            number = draw(st.sampled_from(NUMBERS)) % 2 ** (8 * width)
            return before + number.to_bytes(width, order) + after[width:]
        case "end":
            return before
        case "cut":
            return before + after[draw(st.integers(1, 300)) :]
        case "put":
            return before + draw(st.binary(min_size=1, max_size=40)) + after
        case "again":
            return before + after[: draw(st.integers(1, 300))] * draw(st.integers(2, 40)) + after
        case _:
            there = draw(st.integers(0, size))
            return before + content[there : there + draw(st.integers(1, 300))] + after


@st.composite
def changed_json(draw: Draw, content: bytes) -> bytes:
    """JSON with one to three values replaced, left out, or under another key."""
    try:
        found = [json.loads(content)]
    except (ValueError, RecursionError):
        # It has been changed before.
        return draw(damaged(content))
    raws = []
    for _ in range(draw(st.integers(1, 3))):
        inside, key = draw(st.sampled_from(list(_places(found))))
        match draw(st.sampled_from(("value", "value", "value", "out", "key", "other"))):
            case "out" if inside is not found:
                del inside[key]
            case "key" if isinstance(inside, dict):
                inside[draw(st.sampled_from(HOSTILE))] = inside.pop(key)
            case "other":
                other, there = draw(st.sampled_from(list(_places(found))))
                inside[key] = json.loads(json.dumps(other[there]))
            case _:
                raws.append(draw(st.sampled_from(JSON) if draw(st.integers(0, 3)) else st.integers().map(str)))
                inside[key] = f"{HOLE}{len(raws) - 1}{HOLE}"
    text = json.dumps(found[0])
    for number, raw in enumerate(raws):
        text = text.replace(f'"{HOLE}{number}{HOLE}"', raw)
    return text.encode()


def _places(value: Any) -> Iterator[tuple[MutableMapping[Any, Any] | MutableSequence[Any], Any]]:
    keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for key in keys:
        yield value, key
        yield from _places(value[key])


@st.composite
def changed_zip(draw: Draw, content: bytes) -> bytes:
    """A zip archive with one or two members changed, left out, renamed or doubled; a member may be JSON, or an archive itself."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [(member.filename, archive.read(member)) for member in archive.infolist()]
    # It has been changed before: a damaged archive can fail anywhere in the decompressors.
    except Exception:
        members = []
    if not members:
        return draw(damaged(content))
    for _ in range(draw(st.integers(1, 2))):
        at = draw(st.integers(0, len(members) - 1))
        name, inner = members[at]
        match draw(st.sampled_from(("content", "content", "content", "content", "out", "name", "twice"))):
            case "out" if len(members) > 1:
                del members[at]
            case "name":
                members[at] = (
                    draw(st.sampled_from((*HOSTILE[2:], "x\0y", name.upper(), name + "/", members[0][0]))),
                    inner,
                )
            case "twice":
                members.append((name, draw(damaged(inner))))
            case _:
                members[at] = name, draw(changed(inner))
    target, how = io.BytesIO(), draw(st.sampled_from((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))
    with warnings.catch_warnings(), zipfile.ZipFile(target, "w", how) as archive:
        # Python warns of doubled members.
        warnings.simplefilter("ignore")
        for name, inner in members:
            archive.writestr(name, inner)
    return target.getvalue()


@st.composite
def changed_safetensors(draw: Draw, content: bytes) -> bytes:
    """Weights whose header is changed, with a length that fits or not; or whose numbers are."""
    size = int.from_bytes(content[:8], "little")
    header, numbers = content[8 : 8 + size], content[8 + size :]
    if draw(st.booleans()):
        header = draw(changed_json(header))
    elif draw(st.booleans()):
        header = draw(damaged(header))
    else:
        numbers = draw(damaged(numbers))
    length = draw(st.sampled_from(NUMBERS)) % 2**64 if draw(st.integers(0, 9)) == 0 else len(header)
    return length.to_bytes(8, "little") + header + numbers


@st.composite
def changed_onnx(draw: Draw, content: bytes) -> bytes:
    """A model with one to three fields of its messages changed, left out or doubled."""
    import onnx

    model = onnx.ModelProto.FromString(content)
    for _ in range(draw(st.integers(1, 3))):
        message, field = draw(st.sampled_from(list(_fields(model))))
        value = getattr(message, field.name)
        repeated = hasattr(value, "append")
        what = draw(st.sampled_from(("value", "value", "value", "out", "twice")))
        if what == "out" or (repeated and not value):
            message.ClearField(field.name)
        elif repeated and what == "twice":
            value.extend(list(value)[: draw(st.integers(1, 3))])
        elif field.message_type is None:
            kept = (value[0] if repeated else value) if what == "value" else b""
            new = _other(draw, field, kept)
            try:
                if repeated:
                    value[draw(st.integers(0, len(value) - 1))] = new
                else:
                    setattr(message, field.name, new)
            except (ValueError, TypeError):
                # A number out of its range, or half a character.
                message.ClearField(field.name)
    written: bytes = model.SerializeToString()
    return written


def _fields(message: Any) -> Iterator[tuple[Any, Any]]:
    for field, value in message.ListFields():
        yield message, field
        if field.message_type is not None:
            for inner in value if hasattr(value, "append") or hasattr(value, "add") else (value,):
                yield from _fields(inner)


def _other(draw: Draw, field: Any, value: Any) -> Any:
    if field.cpp_type in (field.CPPTYPE_FLOAT, field.CPPTYPE_DOUBLE):
        return draw(st.floats(width=32))
    if field.cpp_type == field.CPPTYPE_STRING:
        if isinstance(value, bytes) and value:
            return draw(damaged(value))
        text = draw(
            st.sampled_from((*HOSTILE, "x", "w", "y", "Flatten", "MatMul", "Loop", "ai.onnx.ml", "com.microsoft"))
        )
        return text.encode() if field.type == field.TYPE_BYTES else text
    return draw(st.one_of(st.sampled_from(NUMBERS), st.integers(-5, 60)))


@st.composite
def changed_table(draw: Draw, content: bytes) -> bytes:
    """Records with one or two columns of other values, another type, name or place, left out or doubled, or with other rows."""
    table = pq.read_table(io.BytesIO(content))
    for _ in range(draw(st.integers(1, 2))):
        at = draw(st.integers(0, table.num_columns - 1))
        name, column = table.column_names[at], table.column(at)
        match draw(st.sampled_from(("value", "value", "value", "type", "name", "out", "twice", "rows", "order"))):
            case "value":
                other = _with_another(draw, column)
                field = table.schema.field(at)
                table = table.set_column(at, field.with_nullable(field.nullable or other.null_count > 0), other)
            case "type":
                kind = draw(
                    st.sampled_from(
                        (pa.string(), pa.int8(), pa.float16(), pa.list_(pa.int64()), pa.null(), pa.binary())
                    )
                )
                table = table.set_column(at, name, pa.nulls(len(column), kind))
            case "name":
                new = draw(st.sampled_from((*HOSTILE, table.column_names[0], name.upper())))
                table = table.rename_columns([*table.column_names[:at], new, *table.column_names[at + 1 :]])
            case "out" if table.num_columns > 1:
                table = table.remove_column(at)
            case "twice":
                table = table.append_column(name, column)
            case "rows":
                rows = draw(st.lists(st.integers(0, max(len(table) - 1, 0)), max_size=9)) if len(table) else []
                table = table.take(pa.array(rows, pa.int64()))
            case _:
                names = table.column_names
                table = table.select([*range(at, len(names)), *range(at)])
    target = io.BytesIO()
    how = {"compression": draw(st.sampled_from(("snappy", "zstd", "none"))), "use_dictionary": draw(st.booleans())}
    pq.write_table(table, target, store_schema=draw(st.booleans()), **how)
    return target.getvalue()


def _with_another(draw: Draw, column: pa.ChunkedArray) -> pa.ChunkedArray:
    """The column with another value in one row, of its own type where that can be."""
    values = column.to_pylist()
    if not values:
        return column
    row = draw(st.integers(0, len(values) - 1))
    texts = st.one_of(st.sampled_from((*HOSTILE, *JSON[:-12])), st.text(max_size=5))
    kind = column.type
    if (pa.types.is_string(kind) or pa.types.is_dictionary(kind)) and str(values[row]).startswith(("{", "[")):
        texts = st.one_of(texts, changed_json(str(values[row]).encode()).map(lambda text: text[:100_000].decode()))
    new = draw(
        st.booleans()
        if pa.types.is_boolean(kind)
        else st.floats(width=32)
        if pa.types.is_floating(kind)
        else st.one_of(
            st.none(),
            texts,
            st.integers(-(2**63), 2**63 - 1),
            st.sampled_from((-1, 0, 1, 2**31, 10**15)),
            st.lists(st.integers(-3, 300), max_size=4),
        )
    )
    values[row] = new
    try:
        return pa.chunked_array([pa.array(values, kind)])
    except (pa.ArrowException, OverflowError, TypeError, ValueError, UnicodeEncodeError):
        values[row] = None
        return pa.chunked_array([pa.array(values, kind)])


@st.composite
def changed_words(draw: Draw, content: bytes) -> bytes:
    """Words of a command line, one or two of which have another key or value; they are parted by zero bytes."""
    words = content.decode().split("\0")
    for _ in range(draw(st.integers(1, 2))):
        at = draw(st.integers(0, len(words) - 1))
        key, _, value = words[at].partition("=")
        new = draw(st.one_of(st.sampled_from(WORDS), st.text(max_size=6), st.integers().map(str)))
        forms = (
            f"{key}={new}",
            f"{key}={new}",
            f"{new}={value}",
            f"{key}={value}{new}",
            f"{key}={value},{new}",
            new,
            words[at],
        )
        words.insert(at, draw(st.sampled_from(forms)))
        if draw(st.booleans()):
            del words[at + 1]
    return "\0".join(words).encode("utf-8", "replace")


def changed(content: bytes) -> st.SearchStrategy[bytes]:
    """Content of any kind, by what it is: its structure, or its bytes."""
    if content.startswith(b"PK"):
        return st.one_of(changed_zip(content), damaged(content))
    if content[:1] in (b"{", b"["):
        return st.one_of(changed_json(content), damaged(content))
    return damaged(content)
