"""Graphs of TensorFlow.js: the same answers as TensorFlow.js itself, and one line for what is not read."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from cavbench.errors import UserError
from cavbench.formats import tfjs_file
from cavbench.formats.tfjs_graph import Graph, read
from cavbench.formats.trial import OperationError, RefusedError
from tests.formats.tfjs_graphs import CASES, attribute, image, ints, masks, model, numbers, resize, write

ANSWERS = json.loads(Path(__file__).with_name("tfjs_answers.json").read_text())
"""Of TensorFlow.js 4.22.0: studies/tfjs_answers.js."""


def refusal(path: Path) -> str:
    with pytest.raises(UserError) as raised:
        read(path, "net")
    line = str(raised.value)
    assert "\n" not in line
    assert len(line) < 400
    return line


@pytest.mark.parametrize("name", CASES)
def test_an_operation_answers_as_tensorflow_js_does(name: str, tmp_path: Path) -> None:
    graph, _ = read(write(tmp_path, CASES[name]), "net")
    given = torch.from_numpy(image()).requires_grad_()
    (found,) = graph(given)
    wanted = torch.tensor(ANSWERS[name]["values"]).reshape(ANSWERS[name]["shape"])
    torch.testing.assert_close(found.detach().float(), wanted.float(), rtol=1e-5, atol=1e-5)
    if found.is_floating_point():
        assert bool(torch.autograd.grad(found.sum(), given)[0].isfinite().all())


def test_a_slice_with_steps_drops_an_axis_as_numpy_does(tmp_path: Path) -> None:
    """Not as TensorFlow.js 4.22.0, which returns other numbers here (findings/tfjs_strided_slice.sh)."""
    case = (
        "StridedSlice",
        masks(begin=2, end=4, shrink_axis=8),
        [None, ints(0, 3, 1, 2), ints(1, 5, 2, 3), ints(1, 2, 2, 1)],
    )
    graph, _ = read(write(tmp_path, case), "net")
    torch.testing.assert_close(graph(torch.from_numpy(image()))[0], torch.from_numpy(image()[0:1, :5:2, 1::2, 2]))


def test_of_equal_scores_those_with_the_lower_numbers_are_the_best(tmp_path: Path) -> None:
    """As TensorFlow and ONNX say; OpenVINO takes others (findings/topk_of_equal_scores.sh)."""
    path = write(tmp_path, ("TopKV2", {"sorted": True}, [None, ints(3)[0]]), (1, 100))
    described = json.loads(path.read_text())
    described["signature"] = {"outputs": {"places": {"name": "answer:1"}}}
    path.write_text(json.dumps(described))
    given = (torch.arange(100) * 37 % 11)[None] / 10
    assert read(path, "net")[0](given)[0].tolist() == [[8, 19, 30]]


def test_a_gradient_is_that_of_the_numbers(tmp_path: Path) -> None:
    for name in ("conv, same, stride 2", "average pool, same", "bilinear, neither, up", "fused, leaky"):
        graph, _ = read(write(tmp_path / name, CASES[name]), "net")
        given = torch.from_numpy(image()).double().requires_grad_()
        precise = graph.double()
        assert torch.autograd.gradcheck(lambda x, net=precise: net(x)[0], given, fast_mode=True)


def test_images_of_another_size_are_resized_by_the_same_ratio(tmp_path: Path) -> None:
    file = tfjs_file.read(write(tmp_path, ("ResizeBilinear", resize(half=True), [None, ints(10, 12)])), "net")
    given = torch.rand(2, 10, 7, 4)
    assert Graph(file)(given)[0].shape == (2, 10, 12, 4)
    assert Graph(file, free=True)(given)[0].shape == (2, 20, 14, 4)


@pytest.mark.parametrize(
    ("quantised", "stored", "wanted"),
    [
        ({"dtype": "float16"}, numbers(4).astype("<f2"), torch.from_numpy(numbers(4)).half().float()),
        ({"dtype": "uint8", "scale": 0.5, "min": -3.0}, ints(0, 2, 4, 255).astype("u1"), torch.tensor([-3.0, -2.0, -1.0, 124.5])),
        ({"dtype": "uint16", "scale": 0.5, "min": -3.0}, ints(0, 2, 4, 9).astype("<u2"), torch.tensor([-3.0, -2.0, -1.0, 1.5])),
    ],
)  # fmt: skip
def test_weights_may_be_quantised(quantised: dict[str, Any], stored: Any, wanted: torch.Tensor, tmp_path: Path) -> None:
    path = write(tmp_path, CASES["slopes"])
    described = json.loads(path.read_text())
    described["weightsManifest"][0]["weights"][0]["quantization"] = quantised
    path.write_text(json.dumps(described))
    path.with_name("weights.bin").write_bytes(stored.tobytes())
    torch.testing.assert_close(tfjs_file.read(path, "net").weights["constant_1"], wanted)


def node(described: dict[str, Any], name: str = "answer") -> dict[str, Any]:
    return next(one for one in described["modelTopology"]["node"] if one["name"] == name)


def weight(described: dict[str, Any]) -> dict[str, Any]:
    return described["weightsManifest"][0]["weights"][0]


def nested(depth: int) -> Any:
    found: Any = 1
    for _ in range(depth):
        found = [found]
    return found


def chain(described: dict[str, Any], count: int) -> None:
    nodes = described["modelTopology"]["node"]
    nodes += [{"name": f"n{i}", "op": "Relu", "input": ["answer" if not i else f"n{i - 1}"]} for i in range(count)]


HOSTILE: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "an operation": (lambda d: node(d).update(op="WriteFile"), "its node 'answer' has the operation 'WriteFile'"),
    "a loop": (lambda d: d["modelTopology"]["library"].update(function=[{}]), "it has functions, as loops and conditions do"),
    "a circle": (lambda d: node(d)["input"].append("answer"), "its nodes form a circle"),
    "no such node": (lambda d: node(d)["input"].append("ghost"), "takes 'ghost', which it does not have"),
    "no such result": (lambda d: node(d)["input"].__setitem__(0, "x:3"), ""),
    "the same node twice": (lambda d: d["modelTopology"]["node"].append(node(d)), "it has the node 'answer' twice"),
    "two inputs": (
        lambda d: (
            d["modelTopology"]["node"].append({**node(d, "x"), "name": "y"}),
            node(d)["input"].append("y"),
        ),
        "it takes 2 inputs",
    ),
    "another type of input": (lambda d: node(d, "x")["attr"]["dtype"].update(type="DT_STRING"), "it takes DT_STRING"),
    "a folder above": (lambda d: d["weightsManifest"][0].update(paths=["../weights.bin"]), "reads '../weights.bin'"),
    "a path": (lambda d: d["weightsManifest"][0].update(paths=["/etc/passwd"]), "reads '/etc/passwd'; a graph may"),
    "a missing file": (lambda d: d["weightsManifest"][0].update(paths=["else.bin"]), "it needs the file else.bin beside it"),
    "a link": (lambda d: d["weightsManifest"][0].update(paths=["link.bin"]), "reads 'link.bin'"),
    "more than the file": (lambda d: weight(d).update(shape=[1000]), "ends at byte 4000, and the file has 16"),
    "less than the file": (lambda d: weight(d).update(shape=[2]), "its weights take 8 bytes, and their files have 16"),
    "a huge shape": (lambda d: weight(d).update(shape=[2**31]), "its weight 'constant_1' has the shape"),
    "many huge sides": (lambda d: weight(d).update(shape=[2**30] * 6), "ends at byte"),
    "a negative shape": (lambda d: weight(d).update(shape=[-4]), "its weight 'constant_1' has the shape [-4]"),
    "a deep shape": (lambda d: weight(d).update(shape=[1] * 7), "has the shape"),
    "text": (lambda d: weight(d).update(dtype="string"), "has the type 'string', which is not read"),
    "the same weight twice": (lambda d: d["weightsManifest"][0]["weights"].append(weight(d)), "the weight 'constant_1' twice"),
    "deep JSON": (lambda d: d.update(more=nested(100)), "nested deeper than 64 levels"),
    "many nodes": (lambda d: chain(d, 20_000), "nodes, at most 20000 are allowed"),
    "no constant": (lambda d: weight(d).update(name="other"), "its constant 'constant_1' is not among its weights"),
    "another format": (lambda d: d.update(format="layers-model"), "it is a layers model: write a graph with"),
    "an output": (lambda d: d.update(signature={"outputs": {"a": {"name": "ghost"}}}), "it returns 'ghost'"),
    "no topology": (lambda d: d.pop("modelTopology"), "it is not a graph of TensorFlow.js, or a damaged one"),
    "numbers": (lambda d: d.update(weightsManifest=7), "it is not a graph of TensorFlow.js, or a damaged one"),
    "no shape": (lambda d: node(d, "x")["attr"].pop("shape"), "it is not a graph of TensorFlow.js, or a damaged one"),
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE)
def test_a_file_that_is_no_such_graph_is_refused_in_one_line(what: str, tmp_path: Path) -> None:
    change, words = HOSTILE[what]
    path = write(tmp_path, CASES["slopes"])
    (tmp_path / "link.bin").symlink_to(tmp_path / "weights.bin")
    described = json.loads(path.read_text())
    change(described)
    path.write_text(json.dumps(described))
    if words:
        assert words in refusal(path)
        return
    with pytest.raises(RefusedError, match="has no result number 3"):
        read(path, "net")[0](torch.from_numpy(image()))


def test_a_long_chain_of_nodes_is_no_recursion(tmp_path: Path) -> None:
    path = write(tmp_path, CASES["slopes"])
    described = json.loads(path.read_text())
    chain(described, 15_000)
    described["modelTopology"]["node"].reverse()
    path.write_text(json.dumps(described))
    graph, _ = read(path, "net")
    assert len(graph.steps) == 15_003
    assert graph(torch.from_numpy(image()))[0].min() == 0


LARGE: dict[str, tuple[str, dict[str, Any], list[Any]]] = {
    "pad": ("Pad", {}, [None, ints(0, 0, 0, 40_000, 0, 40_000, 0, 0).reshape(4, 2)]),
    "resize": ("ResizeBilinear", resize(half=True), [None, ints(100_000, 100_000)]),
    "tile": ("Tile", {}, [None, ints(1, 10_000, 10_000, 1)]),
    "fill": ("Fill", {}, [ints(100_000, 100_000), ints(3)[0]]),
    "range": ("Range", {}, [ints(0)[0], ints(2**31 - 1)[0], ints(1)[0]]),
    "broadcast": ("Add", {}, [numbers(20_000, 1, 1, 1, 1), numbers(1, 20_000, 1, 1, 1)]),
    "convolution": ("Conv2D", {"padding": "EXPLICIT", "strides": [1, 1, 1, 1], "dilations": [1, 1, 1, 1], "data_format": "NHWC",
        "explicit_paddings": [0, 0, 50_000, 0, 50_000, 0, 0, 0]}, [None, numbers(1, 1, 4, 1)]),
}  # fmt: skip


@pytest.mark.parametrize("what", LARGE)
def test_a_value_that_would_fill_the_memory_is_not_made(what: str, tmp_path: Path) -> None:
    graph, _ = read(write(tmp_path, LARGE[what]), "net") if what not in ("fill", "range", "broadcast") else (None, "")
    if graph is None:
        # They take no image: it is an input all the same.
        path = write(tmp_path, LARGE[what])
        described = json.loads(path.read_text())
        described["modelTopology"]["node"].append(
            {"name": "both", "op": "Pack", "input": ["answer", "x"], "attr": {"axis": attribute(0)}}
        )
        path.write_text(json.dumps(described))
        graph, _ = read(path, "net")
    with pytest.raises(RefusedError, match="its values have too many numbers for its input"):
        graph(torch.from_numpy(image()))


def test_what_fails_within_a_graph_names_the_node(tmp_path: Path) -> None:
    described, content = model(("Reshape", {}, [None, ints(7, 7)]))
    (tmp_path / "model.json").write_text(json.dumps(described))
    (tmp_path / "weights.bin").write_bytes(content)
    with pytest.raises(OperationError, match=r"Reshape \(answer\)"):
        read(tmp_path / "model.json", "net")[0](torch.from_numpy(image()))
