"""One hash covers all that an ONNX file makes the program compute with, and nothing beside its folder is read."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from cavbench.formats.onnx_file import whole
from cavbench.run.config import component

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
helper = onnx.helper
SIZE = 250


def beside(place: str = "weights", dims: tuple[int, ...] = (50, 5), **said: str) -> Any:
    """A tensor in another file."""
    tensor = onnx.TensorProto(name="w", dims=dims, data_type=1, data_location=1)
    for key, value in {"location": place, **said}.items():
        tensor.external_data.add(key=key, value=value)
    return tensor


def model(weight: Any, where: str = "initializer") -> Any:
    """A policy whose matrix is in one of the places where ONNX allows a tensor."""
    product = helper.make_node("MatMul", ["f", "w"], ["y"])
    nodes, functions, initializers, sparse = [helper.make_node("Flatten", ["x"], ["f"]), product], [], [], []
    domains = [helper.make_opsetid("", 17), helper.make_opsetid("own", 1)]
    constant = helper.make_node("Constant", [], ["w"], value=weight)
    output = helper.make_tensor_value_info("y", 1, ["batch", 5])
    match where:
        case "initializer":
            initializers = [weight]
        case "attribute":
            nodes.insert(0, constant)
        case "body of a branch":
            inner = helper.make_tensor_value_info("z", 1, ["batch", 5])
            bodies = {
                f"{name}_branch": helper.make_graph(
                    [helper.make_node("MatMul", ["f", "w"], ["z"])], name, [], [inner], initializer=[weight]
                )
                for name in ("then", "else")
            }
            always = helper.make_node("Constant", [], ["yes"], value=helper.make_tensor("yes", 9, [], [True]))
            nodes[1:] = [always, helper.make_node("If", ["yes"], ["y"], **bodies)]
        case "function":
            own = [helper.make_opsetid("", 17)]
            functions = [helper.make_function("own", "Layer", ["f"], ["y"], [constant, product], own)]
            nodes[1] = helper.make_node("Layer", ["f"], ["y"], domain="own")
        case "sparse":
            index = helper.make_tensor("i", 7, [SIZE], range(SIZE))
            sparse = [onnx.SparseTensorProto(values=weight, indices=index, dims=[50, 5])]
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info("x", 1, ["batch", 10, 5])],
        [output],
        initializer=initializers,
        sparse_initializer=sparse,
    )
    return helper.make_model(graph, opset_imports=domains, functions=functions, ir_version=9)


def written(folder: Path, made: Any) -> Path:
    path = folder / "policy.onnx"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(made if isinstance(made, bytes) else made.SerializeToString())
    return path


def numbers(path: Path, seed: int) -> torch.Tensor:
    values = torch.rand(SIZE, generator=torch.Generator().manual_seed(seed))
    path.write_bytes(values.numpy().tobytes())
    return values.reshape(50, 5)


def load(path: Path) -> Any:
    return component("victim", "onnx", {"path": str(path)}).load(0, HighwayWorld().facts)


def refusal(path: Path) -> str:
    with pytest.raises(UserError) as raised:
        whole(path, str(path))
    line = str(raised.value)
    assert "\n" not in line
    assert len(line) < 400
    return line


PLACES = {
    "initializer": (50, 5),
    "attribute": (50, 5),
    "body of a branch": (50, 5),
    "function": (50, 5),
    "sparse": (SIZE,),
}


@pytest.mark.parametrize("where", PLACES)
def test_the_tensors_beside_a_model_are_read_and_hashed_wherever_it_names_them(where: str, tmp_path: Path) -> None:
    path = written(tmp_path, model(beside(dims=PLACES[where]), where))
    observation, hashes = torch.rand(3, 10, 5), set()
    for seed in (1, 2):
        weights = numbers(tmp_path / "weights", seed)
        policy = load(path)
        torch.testing.assert_close(policy.scores(observation), observation.flatten(1) @ weights)
        hashes.add(policy.weights_sha256)
    assert len(hashes) == 2


@pytest.mark.parametrize("where", PLACES)
def test_a_model_reads_no_file_of_another_folder(where: str, tmp_path: Path) -> None:
    numbers(tmp_path / "secret", 1)
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path / "secret")
    # The last one is ONNX Runtime's own word for an address in memory.
    for place in ("../secret", str(tmp_path / "secret"), "link", "..", "", "*/_ORT_MEM_ADDR_/*"):
        line = refusal(written(folder, model(beside(place, PLACES[where]), where)))
        assert f"it reads {place!r}; a model may read files in its own folder only" in line


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ({"length": "996"}, "has other sizes in 'weights' than in the model"),
        ({"offset": "-4"}, "has other sizes in 'weights'"),
        ({"offset": "4"}, "weights ends before the tensor 'w' does"),
        ({"basepath": ".."}, "or in words that are not known: 'location, basepath'"),
        ({"location": "nothing"}, "it needs the file 'nothing' beside it"),
        ({"location": "a\nb"}, "which is no name of a file"),
        ({"location": 300 * "a"}, "which is no name of a file"),
    ],
)
def test_a_tensor_beside_a_model_is_where_the_model_says(said: dict[str, str], why: str, tmp_path: Path) -> None:
    numbers(tmp_path / "weights", 1)
    found = refusal(written(tmp_path, model(beside(**said))))
    assert why in found
    assert len(found.splitlines()) == 1


def test_parts_of_one_file_are_told_apart(tmp_path: Path) -> None:
    values = torch.rand(2 * SIZE)
    (tmp_path / "weights").write_bytes(values.numpy().tobytes())
    observation = torch.rand(3, 10, 5)
    for start in (0, 1, SIZE):
        place = {"offset": str(4 * start), "length": str(4 * SIZE), "checksum": "any"}
        scores = load(written(tmp_path, model(beside(**place)))).scores(observation)
        torch.testing.assert_close(scores, observation.flatten(1) @ values[start : start + SIZE].reshape(50, 5))


def in_both(made: Any) -> None:
    made.graph.initializer[0].raw_data = bytes(4 * SIZE)


def twice(made: Any) -> None:
    made.graph.initializer[0].external_data.add(key="location", value="other")


@pytest.mark.parametrize(
    ("change", "why"), [(in_both, "it may lie in one of them only"), (twice, "says where it lies twice")]
)
def test_a_tensor_that_can_be_read_in_two_ways_is_refused(
    change: Callable[[Any], None], why: str, tmp_path: Path
) -> None:
    numbers(tmp_path / "weights", 1)
    made = model(beside())
    change(made)
    assert why in refusal(written(tmp_path, made))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_beside_a_model_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "weights")
    assert "it needs the file" in refusal(written(tmp_path, model(beside())))


def test_a_file_beside_that_is_too_large_is_refused_before_it_is_read(tmp_path: Path) -> None:
    with (tmp_path / "weights").open("wb") as file:
        file.truncate(2**32)
    line = refusal(written(tmp_path, model(beside(dims=(2**15, 2**15)))))
    assert "it has more than 1 GiB with the files beside it" in line


def varint(number: int, length: int = 1) -> bytes:
    """A number of a protocol buffer, written with at least so many bytes."""
    parts = []
    while number >= 128 or len(parts) < length - 1:
        parts.append(number & 127 | 128)
        number >>= 7
    return bytes([*parts, number])


@settings(max_examples=60, deadline=None)
@given(
    tag=st.integers(1, 10),
    length=st.integers(1, 10),
    above=st.integers(0, 63),
    field=st.sampled_from(["graph", "initializer", "location"]),
)
def test_however_a_tag_is_written_the_data_beside_is_in_the_hash_or_the_file_is_refused(
    tag: int, length: int, above: int, field: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """A parser that keeps more bits of a tag than another one sees other fields."""
    folder = tmp_path_factory.mktemp("tags")
    made = model(beside())

    def member(number: int, content: bytes, name: str) -> bytes:
        key = number << 3 | 2
        if name != field:
            return varint(key) + varint(len(content)) + content
        return varint(key | (above << 32 if tag > 5 else 0), tag) + varint(len(content), length) + content

    entry = member(2, b"weights", "location")
    tensor = b"".join([b"\x08\x32\x08\x05\x10\x01", member(8, b"w", "name"), b"\x70\x01"])
    tensor += member(13, member(1, b"location", "key") + entry, "external")
    made.graph.ClearField("initializer")
    graph = made.graph.SerializeToString() + member(5, tensor, "initializer")
    made.ClearField("graph")
    path = written(folder, made.SerializeToString() + member(7, graph, "graph"))
    found = []
    for seed in (1, 2):
        weights = numbers(folder / "weights", seed)
        try:
            content = whole(path, "policy.onnx")
        except UserError:
            return
        assert weights.numpy().tobytes() in content
        found.append(content)
    assert found[0] != found[1]


def test_a_file_with_unknown_fields_is_refused(tmp_path: Path) -> None:
    numbers(tmp_path / "weights", 1)
    content = model(beside()).SerializeToString()
    for unknown in (varint(3000 << 3 | 2) + b"\x01x", varint(3000 << 3) + b"\x01", varint(7 << 3) + b"\x01"):
        assert "fields or values that onnx" in refusal(written(tmp_path, content + unknown))
    inner = model(beside())
    inner.graph.initializer[0].MergeFromString(varint(3000 << 3) + b"\x01")
    assert "fields or values that onnx" in refusal(written(tmp_path, inner))


def test_settings_in_a_model_do_not_reach_onnx_runtime(tmp_path: Path) -> None:
    numbers(tmp_path / "weights", 1)
    made = model(beside())
    made.metadata_props.add(key="ort_config", value='{"session_options": {"intra_op_num_threads": 8}}')
    made.graph.node[0].metadata_props.add(key="any", value="words")
    made.training_info.add().initialization.initializer.append(beside("../secret"))
    plain, noted = (whole(written(tmp_path, one), "policy.onnx") for one in (model(beside()), made))
    assert noted == plain


@pytest.mark.parametrize("content", [b"", b"ORTM" + bytes(60), b"\x3a\xff", b"no model", b"PK\x03\x04"])
def test_what_is_no_model_is_refused(content: bytes, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"it is not an ONNX model, or a damaged one|is refused: it has fields"):
        load(written(tmp_path, content))


@pytest.mark.parametrize("said", [{"offset": "0"}, {"checksum": "0"}])
def test_text_that_is_not_utf8_says_nowhere(said: dict[str, str], tmp_path: Path) -> None:
    content = model(beside(**said)).SerializeToString()
    path = written(tmp_path, content.replace(b"location", b"loc\xfftion"))
    numbers(tmp_path / "weights", 1)
    assert "in words that are not known" in refusal(path)
