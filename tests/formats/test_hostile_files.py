"""Files that would execute code, or fill the memory, in a loader that trusts them: each is refused in one line."""

from __future__ import annotations

import contextlib
import ctypes
import io
import json
import os
import pickle
import struct
import sys
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn

from cavbench.archive import Archive
from cavbench.detection.victims import yolov5_file
from cavbench.driving import DrivingFacts
from cavbench.driving.victims.from_file import FileDriver, FilePolicy
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from cavbench.formats.torch_operations import operation
from cavbench.formats.trial import RefusedError
from cavbench.run.config import component

FACTS = HighwayWorld().facts
Members = dict[str, bytes]
PROGRAM, WEIGHTS, CONSTANTS = (
    "models/model.json",
    "data/weights/model_weights_config.json",
    "data/constants/model_constants_config.json",
)


class Small(nn.Module):
    """A policy with a parameter and a constant, and with the parts of a program that are rare."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Flatten(), nn.Linear(50, 8), nn.LayerNorm(8), nn.ReLU(inplace=True), nn.Linear(8, 5)
        )
        self.mix = nn.MultiheadAttention(5, 1, batch_first=True)
        self.remember = nn.GRU(5, 5, batch_first=True)
        self.scale = torch.linspace(0.5, 1, 5)

    def forward(self, observation: Tensor) -> Tensor:
        mixed, _ = self.mix(observation, observation, observation)
        mixed, _ = self.remember(mixed / self.scale)
        scores = self.net(observation + mixed)
        with torch.no_grad():
            best = scores.max(-1, keepdim=True).values
        first, *_ = scores.chunk(2, -1)
        return (
            scores
            - best
            + torch.cat([first, first], -1).sum(-1, keepdim=True)
            + scores[torch.arange(observation.shape[0]), 0, None]
        )


@pytest.fixture(scope="module")
def program() -> torch.export.ExportedProgram:
    batch = {"observation": {0: torch.export.Dim("batch")}}
    return torch.export.export(Small().eval(), (torch.rand(3, 10, 5),), dynamic_shapes=batch)


@pytest.fixture(scope="module")
def honest(program: torch.export.ExportedProgram, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("honest") / "policy.pt2"
    torch.export.save(program, path)
    return path


def load(path: Path, name: str = "torch", **values: str) -> Any:
    return component("victim", name, {"path": str(path), **values}).load(0, FACTS)


def refusal(path: Path, name: str = "torch", **values: str) -> str:
    with pytest.raises(UserError) as raised:
        load(path, name, **values)
    line = str(raised.value)
    assert "\n" not in line
    assert len(line) < 400
    return line


def test_an_honest_program_is_computed_bit_for_bit_as_by_torch(
    honest: Path, program: torch.export.ExportedProgram
) -> None:
    ours, theirs = load(honest), program.module().requires_grad_(False)
    for batch in (1, 2, 700):
        own = torch.rand(batch, 10, 5, generator=torch.Generator().manual_seed(batch)).requires_grad_()
        other = own.detach().clone().requires_grad_()
        found, wanted = ours.scores(own), theirs(other)
        assert torch.equal(found, wanted)
        gradients = torch.autograd.grad(found[:, 2].sum(), own), torch.autograd.grad(wanted[:, 2].sum(), other)
        assert torch.equal(gradients[0][0], gradients[1][0])


class Harm:
    """Makes a folder when it is unpickled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.folder),)


def pickled(harm: Path, *, plain: bool = False) -> bytes:
    file = io.BytesIO()
    torch.save({"x": Harm(harm)}, file)
    return pickle.dumps(Harm(harm)) if plain else file.getvalue()


def edited(members: Members, name: str, change: Callable[[Any], None]) -> None:
    content = json.loads(members[name])
    change(content)
    members[name] = json.dumps(content).encode()


def pickled_weight(members: Members, harm: Path) -> None:
    edited(members, WEIGHTS, lambda found: found["config"]["net.1.bias"].update(use_pickle=True))
    members["data/weights/weight_1"] = pickled(harm)


def pickled_constant(members: Members, harm: Path) -> None:
    edited(members, CONSTANTS, lambda found: found["config"]["scale"].update(use_pickle=True))
    members["data/constants/tensor_0"] = pickled(harm)


def held(kind: str, *, listed: bool = True) -> Callable[[Members, Path], None]:
    def craft(members: Members, harm: Path) -> None:
        entry = {"path_name": f"{kind}_0", "is_param": False, "use_pickle": True, "tensor_meta": None}
        if listed:
            edited(members, CONSTANTS, lambda found: found["config"].update(other=entry))
        members[f"data/constants/{kind}_0"] = pickled(harm, plain=kind == "opaque_obj")

    return craft


def sample_inputs(members: Members, harm: Path) -> None:
    members["data/sample_inputs/model.pt"] = pickled(harm)


def plain_sample_inputs(members: Members, harm: Path) -> None:
    members["data/sample_inputs/model.pt"] = pickled(harm, plain=True)


def legacy_weights(members: Members, harm: Path) -> None:
    members["data/weights/model.pt"] = pickled(harm)


def legacy_constants(members: Members, harm: Path) -> None:
    members["data/constants/model.pt"] = pickled(harm)


def compiled(members: Members, harm: Path) -> None:
    members["data/aotinductor/model/model.so"] = b"\x7fELF"


def second_program(members: Members, harm: Path) -> None:
    members["models/other.json"] = members[PROGRAM]
    members["data/sample_inputs/other.pt"] = pickled(harm)


def calls(target: str, *arguments: dict[str, Any]) -> Callable[[Members, Path], None]:
    """A program whose first operation calls something else."""

    def craft(members: Members, harm: Path) -> None:
        given = [json.loads(json.dumps(argument).replace("HARM", str(harm))) for argument in arguments]
        inputs = [{"name": f"a{n}", "arg": argument, "kind": 1} for n, argument in enumerate(given)]
        node = {"target": target, "inputs": inputs, "outputs": [{"as_none": True}], "metadata": {}, "name": None}
        edited(members, PROGRAM, lambda found: found["graph_module"]["graph"]["nodes"].insert(0, node))

    return craft


def changes_a_weight(members: Members, harm: Path) -> None:
    def change(found: Any) -> None:
        weight = found["graph_module"]["graph"]["inputs"][0]
        inputs = [{"name": "self", "arg": weight, "kind": 1}]
        node = {"target": "torch.ops.aten.zero_.default", "inputs": inputs, "outputs": [{"as_tensor": {"name": "z"}}]}
        found["graph_module"]["graph"]["nodes"].insert(0, node)

    edited(members, PROGRAM, change)


def changes_a_view(members: Members, harm: Path) -> None:
    view, zero = {"as_tensor": {"name": "view"}}, {"as_tensor": {"name": "zero"}}
    calls("torch.ops.aten.zero_.default", view)(members, harm)
    weight = json.loads(members[PROGRAM])["graph_module"]["graph"]["inputs"][0]
    calls("torch.ops.aten.view.default", weight, {"as_ints": [-1]})(members, harm)

    def change(found: Any) -> None:
        for node, output in zip(found["graph_module"]["graph"]["nodes"], (view, zero), strict=False):
            node["outputs"] = [output]

    edited(members, PROGRAM, change)


def long_name(members: Members, harm: Path) -> None:
    members["q" * 60_000] = b""


def norm(name: str) -> Callable[[Members, Path], None]:
    """A batch norm of a weight with 128 channels, with the statistics of one: torch's kernels write past their end."""

    def craft(members: Members, harm: Path) -> None:
        inputs = json.loads(members[PROGRAM])["graph_module"]["graph"]["inputs"]
        none, short = {"as_none": True}, inputs[-2]
        training = [{"as_bool": True}] if name != "_native_batch_norm_legit_no_training" else []
        given = [inputs[0], none, none, short, short, *training, {"as_float": 0.5}, {"as_float": 0.1}]
        calls(f"torch.ops.aten.{name}.default", *given)(members, harm)

    return craft


HARM = {"as_string": "HARM"}
CRAFTED: dict[str, tuple[Callable[[Members, Path], None], str]] = {
    "a pickled weight": (pickled_weight, "'net.1.bias' is pickled: only plain tensors are loaded"),
    "a pickled constant": (pickled_constant, "'scale' is pickled"),
    "an opaque object": (held("opaque_obj"), "it holds 'data/constants/opaque_obj_0'; pickled objects are not loaded"),
    "a script object": (held("custom_obj"), "it holds 'data/constants/custom_obj_0'; pickled objects are not loaded"),
    "an unlisted object": (held("opaque_obj", listed=False), "pickled objects are not loaded"),
    "sample inputs": (sample_inputs, "its sample inputs name posix.mkdir, which is code"),
    "plain sample inputs": (plain_sample_inputs, "data/sample_inputs/model.pt cannot be read: it is not a zip archive"),
    "weights of an old format": (legacy_weights, "it holds 'data/weights/model.pt'; pickled objects are not loaded"),
    "constants of an old format": (legacy_constants, "it holds 'data/constants/model.pt'"),
    "a compiled library": (compiled, "it holds 'data/aotinductor/model/model.so'; compiled code is not run"),
    "a second program": (second_program, "it holds 'models/other.json'"),
    "a function of Python": (calls("torch.os.mkdir", HARM), "it calls 'torch.os.mkdir'; only the operations of ATen"),
    "a loader": (calls("torch.load", HARM), "it calls 'torch.load'"),
    "a library": (calls("torch.ops.load_library", HARM), "it calls 'torch.ops.load_library'"),
    "an attribute": (calls("torch.ops.aten.__class__.mro"), "it calls 'torch.ops.aten.__class__.mro'"),
    "an attribute of an operation": (
        calls("torch.ops.aten.relu.__class__"),
        "it calls 'torch.ops.aten.relu.__class__'",
    ),
    "an operator": (calls("_operator.methodcaller", HARM), "it calls '_operator.methodcaller'"),
    "a module by name": (
        calls("torch._export.custom_ops._call_custom_autograd_function_in_pre_dispatch", HARM),
        "only the operations of ATen",
    ),
    "a file of its own": (
        calls("torch.ops.aten.from_file.default", HARM, {"as_bool": True}, {"as_int": 64}),
        "it calls 'torch.ops.aten.from_file.default', which is not an operation of a forward pass",
    ),
    "a file by another operation": (
        calls("torch.ops.aten.add.Tensor", HARM),
        "an operation has an argument that is not read (as_string",
    ),
    "a number that fills the memory": (
        calls("_operator.mul", {"as_int": 2**62}, {"as_int": 8}),
        "is refused: _operator.mul makes a number that is too large",
    ),
    "an operation that fails": (
        calls("torch.ops.aten.view.default", {"as_tensor": {"name": "observation"}}, {"as_ints": [7]}),
        "fails on 1 observation: the operation aten.view.default fails",
    ),
    "a member with a long name": (long_name, "it holds 'qqq"),
    "a batch norm past the end of its statistics": (
        norm("native_batch_norm"),
        "'torch.ops.aten.native_batch_norm.default'",
    ),
    "the same in eval mode": (
        norm("_native_batch_norm_legit_no_training"),
        "is refused: a batch norm has weights or statistics of another size than its input",
    ),
    "a sparse tensor": (calls("torch.ops.aten.to_sparse.default"), "'torch.ops.aten.to_sparse.default', which is not"),
    "another layer's weights": (changes_a_weight, "changes its own weights: export it in eval mode"),
    "a view of a weight": (changes_a_view, "changes its own weights: export it in eval mode"),
    "an LSTM without weights, whose sizes torch does not check": (
        calls(
            "torch.ops.aten.lstm.input",
            {"as_tensor": {"name": "observation"}},
            {"as_tensors": [{"name": "observation"}] * 2},
            {"as_tensors": []},
            *[{"as_bool": True}, {"as_int": 1}, {"as_float": 0.0}, *[{"as_bool": False}] * 3],
        ),
        "is refused: a recurrent network has weights or states of another size than its layers",
    ),
}


def rewritten(honest: Path, path: Path, craft: Callable[[Members, Path], None], harm: Path) -> Path:
    with zipfile.ZipFile(honest) as archive:
        members = {name.partition("/")[2]: archive.read(name) for name in archive.namelist()}
    craft(members, harm)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(f"policy/{name}", content)
    return path


@pytest.mark.parametrize("what", CRAFTED)
def test_a_crafted_program_executes_nothing_and_is_refused(what: str, honest: Path, tmp_path: Path) -> None:
    craft, part = CRAFTED[what]
    path, harm = rewritten(honest, tmp_path / "crafted.pt2", craft, tmp_path / "harm"), tmp_path / "harm"
    line = refusal(path)
    assert part in line
    assert str(path) in line
    assert not harm.exists()


@pytest.mark.parametrize("what", ["a pickled weight", "a pickled constant", "an opaque object", "sample inputs"])
def test_the_crafted_programs_do_harm_when_torch_loads_them(what: str, honest: Path, tmp_path: Path) -> None:
    path, harm = rewritten(honest, tmp_path / "crafted.pt2", CRAFTED[what][0], tmp_path / "harm"), tmp_path / "harm"
    with contextlib.suppress(Exception):
        torch.export.load(path)
    assert harm.exists()


@pytest.mark.parametrize(
    ("name", "sizes", "numbers", "why"),
    [
        ("batch_norm", [[4, 9], [1], [1], [9], [9]], [False, 0.1, 1e-5, False], "a batch norm has weights"),
        ("batch_norm", [[4, 9], [9], [9], [9], [9]], [True, 0.1, 1e-5, False], "changes its own weights"),
        ("instance_norm", [[4, 9, 2], [9], [9], [9], [9]], [True, 0.1, 1e-5, False], "changes its own weights"),
        ("native_group_norm", [[1, 4, 2], [4], [4]], [1000, 4, 1000, 2, 1e-5], "a group norm has other sizes"),
        ("_weight_norm", [[9, 4], [1, 1]], [0], "a weight norm has lengths of another size"),
        ("scaled_dot_product_attention", [[2, 1, 9, 4], [2, 1, 9, 4], [2, 1, 2, 4]], [], "an attention has queries"),
        ("scaled_dot_product_attention", [[2, 1, 9, 4]] * 3 + [[2, 9]], [], "an attention has a mask"),
        ("_scaled_dot_product_flash_attention_for_cpu", [[2, 3, 9, 4], [1, 1, 9, 4], [1, 1, 9, 4]], [], "has queries"),
    ],
)
def test_sizes_that_torch_does_not_check_are_checked(
    name: str, sizes: list[list[int]], numbers: list[float], why: str
) -> None:
    _, call = operation(f"torch.ops.aten.{name}.default")
    with pytest.raises(RefusedError, match=why):
        call(*(torch.ones(size) for size in sizes), *numbers)


@pytest.mark.parametrize("network", [nn.GRU, nn.RNN])
@pytest.mark.parametrize("bidirectional", [False, True])
def test_a_recurrent_network_needs_the_weights_of_all_its_layers(
    network: type[nn.GRU | nn.RNN], bidirectional: bool
) -> None:
    made = network(5, 7, 2, bidirectional=bidirectional)
    name = {nn.GRU: "gru", nn.RNN: "rnn_tanh"}[network]
    found, call = operation(f"torch.ops.aten.{name}.input")
    weights, input, hidden = made._flat_weights, torch.rand(3, 4, 5), torch.zeros(4 if bidirectional else 2, 4, 7)
    rest = [True, 2, 0.0, False, bidirectional, False]
    torch.testing.assert_close(call(input, hidden, weights, *rest), found(input, hidden, weights, *rest))
    short = [*weights[:-1], weights[-1][:1]]
    for wrong in (weights[4:], [*weights[4:], *weights[:4]], short):
        with pytest.raises(RefusedError, match="a recurrent network has weights or states"):
            call(input, hidden, wrong, *rest)
    with pytest.raises(RefusedError, match="a recurrent network has weights or states"):
        call(input, hidden, weights, True, 2**60, *rest[2:])


@pytest.mark.parametrize("bidirectional", [False, True])
@pytest.mark.parametrize("batch_first", [False, True])
def test_an_lstm_needs_weights_and_states_of_the_sizes_of_its_layers(bidirectional: bool, batch_first: bool) -> None:
    made = nn.LSTM(5, 7, 2, bidirectional=bidirectional)
    found, call = operation("torch.ops.aten.lstm.input")
    weights, layers = made._flat_weights, 4 if bidirectional else 2
    input, rest = torch.rand(3, 4, 5), [True, 2, 0.0, False, bidirectional, batch_first]
    state = torch.rand(layers, 3 if batch_first else 4, 7)
    for own, other in zip(
        call(input, [state, state], weights, *rest), found(input, [state, state], weights, *rest), strict=True
    ):
        assert torch.equal(own, other)
    for states in (
        [state],
        [state[1:], state],
        [state, state[:, 1:]],
        [state, state[..., 1:]],
        [state, state.double()],
    ):
        with pytest.raises(RefusedError, match="a recurrent network has weights or states"):
            call(input, states, weights, *rest)
    for wrong in (weights[4:], [*weights[4:], *weights[:4]], [*weights[:-1], weights[-1][:1]], []):
        with pytest.raises(RefusedError, match="a recurrent network has weights or states"):
            call(input, [state, state], wrong, *rest)
    for sequence in (input[0], input[:0], input.double()):
        with pytest.raises(RefusedError, match="a recurrent network has weights or states"):
            call(sequence, [state, state], weights, *rest)


def test_memory_that_a_program_does_not_fill_is_zero() -> None:
    _, call = operation("torch.ops.aten.empty_like.default")
    assert not call(torch.full((1000,), 7.0)).any()


def test_sizes_that_fit_are_computed_as_by_torch() -> None:
    query, mask = torch.rand(2, 1, 9, 4), torch.rand(9, 9)
    for name, given in {
        "batch_norm": [torch.rand(4, 9), *[torch.rand(9)] * 4, False, 0.1, 1e-5, False],
        "native_group_norm": [torch.rand(3, 4, 2), torch.rand(4), torch.rand(4), 3, 4, 2, 2, 1e-5],
        "_weight_norm": [torch.rand(9, 4), torch.rand(9, 1), 0],
        "scaled_dot_product_attention": [query, query, query, mask],
    }.items():
        found, call = operation(f"torch.ops.aten.{name}.default")
        torch.testing.assert_close(call(*given), found(*given), rtol=0, atol=0)


@dataclass(frozen=True, kw_only=True)
class Crashing(FileDriver):
    """A victim whose library crashes on its file."""

    format: ClassVar[str] = "a file that crashes"

    def read(self, path: Path, sha256: str, facts: DrivingFacts) -> FilePolicy:
        ctypes.string_at(0)
        raise AssertionError


@pytest.mark.skipif(sys.platform != "linux", reason="the file is tried in a copy of the process on Linux only")
def test_a_file_that_crashes_its_library_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "crash.bin"
    path.write_bytes(b"crash")
    with pytest.raises(UserError, match=r"crash.bin is refused: reading and trying it ends the process \(SIGSEGV\)"):
        Crashing(path=str(path)).load(0, FACTS)


def code_in_text(members: Members, harm: Path) -> None:
    """Code wherever torch evaluates text: expressions of sizes, guards, names that become Python, the trees of arguments."""
    code = f"__import__('os').mkdir({str(harm)!r})"

    def change(found: Any) -> None:
        graph = found["graph_module"]["graph"]
        for size in graph["tensor_values"].values():
            for side in size["sizes"]:
                if "as_expr" in side:
                    side["as_expr"]["expr_str"] = code
        found["guards_code"] = [code]
        found["graph_module"]["module_call_graph"][0]["signature"]["forward_arg_names"] = [f"x={code}"]
        for node in graph["nodes"]:
            node["metadata"] = {"nn_module_stack": code, "custom": code}

    edited(members, PROGRAM, change)
    members[PROGRAM] = members[PROGRAM].replace(b'"observation"', json.dumps(f"observation={code}").encode())


def test_text_that_torch_would_evaluate_is_never_evaluated(honest: Path, tmp_path: Path) -> None:
    path, harm = rewritten(honest, tmp_path / "text.pt2", code_in_text, tmp_path / "harm"), tmp_path / "harm"
    observation = torch.rand(4, 10, 5)
    assert torch.equal(load(path).scores(observation), load(honest).scores(observation))
    assert not harm.exists()
    with contextlib.suppress(Exception):
        torch.export.load(path).module()
    assert harm.exists()


def test_a_program_of_the_old_format_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "old.pt2", "w") as archive:
        archive.writestr("version", "8.1")
        archive.writestr("serialized_state_dict.pt", pickled(tmp_path / "harm"))
    assert "it is not written by torch.export.save of torch 2.8 or later" in refusal(tmp_path / "old.pt2")
    assert not (tmp_path / "harm").exists()


def test_a_pickle_and_a_torchscript_archive_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.pt2").write_bytes(pickled(tmp_path / "harm", plain=True))
    assert "it is not a zip archive" in refusal(tmp_path / "a.pt2")
    torch.save(Harm(tmp_path / "harm"), tmp_path / "b.pt2")
    assert "it is not written by torch.export.save" in refusal(tmp_path / "b.pt2")
    assert not (tmp_path / "harm").exists()


def bomb(path: Path, name: str, size: int = 40_000_000) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        archive.writestr(name, bytes(size))
    return path


@pytest.mark.parametrize(
    ("victim", "name", "values"),
    [
        ("torch", "policy/archive_format", {}),
        ("sb3", "policy.pth", {"algo": "dqn"}),
        ("yolov5", "archive/data.pkl", {}),
    ],
)
def test_a_bomb_is_refused_before_it_is_unpacked(
    victim: str, name: str, values: dict[str, str], tmp_path: Path
) -> None:
    path = bomb(tmp_path / "bomb.pt", name)
    assert path.stat().st_size < 100_000
    read: Callable[[], object] = (
        (lambda: yolov5_file.read(path)) if victim == "yolov5" else (lambda: load(path, victim, **values))
    )
    with pytest.raises(UserError, match=r"is refused: \d+\.\d kB unpack to 40\.0 MB, more than the \d+\.\d MB allowed"):
        read()


def test_a_member_that_states_a_smaller_size_is_not_unpacked_further(tmp_path: Path) -> None:
    content = bytearray(bomb(tmp_path / "liar.zip", "data", 20_000_000).read_bytes())
    # The directory at the end states the sizes: 46 bytes of a member's entry, the unpacked size at 24.
    entry = content.rindex(b"PK\x01\x02")
    content[entry + 24 : entry + 28] = struct.pack("<I", 1000)
    with pytest.raises(UserError, match="damaged"):
        Archive(bytes(content), "liar.zip")


def zipped(*members: tuple[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members:
            archive.writestr(name, content)
    return file.getvalue()


def with_comment(content: bytes) -> bytes:
    return content[:-2] + struct.pack("<H", 22) + content[-22:]


def renamed(content: bytes) -> bytes:
    """The list at the end has another name than the member itself."""
    place = content.rindex(b"data")
    return content[:place] + b"dbta" + content[place + 4 :]


HONEST = zipped(("data", b"one"), ("more", b"two"))
DAMAGED, ALONE = "it is not a zip archive, or a damaged one", "there is something before or after it"
READ_OTHERWISE = {
    "names that differ in case": (zipped(("data", b"one"), ("Data", b"two")), "two of its members have the same name"),
    "the same in another alphabet": (zipped(("stra\u00dfe", b"1"), ("STRASSE", b"2")), "have the same name"),
    "bytes before": (b"MZ" + HONEST, ALONE),
    "an archive before": (HONEST + zipped(("data", b"two")), ALONE),
    "bytes after": (HONEST + b"more", f"{DAMAGED}|{ALONE}"),
    "a second end in a comment": (with_comment(HONEST), f"{DAMAGED}|{ALONE}"),
    "a zero byte in a name": (
        zipped(("data.x", b"1")).replace(b"data.x", b"data\0x"),
        "a name that others read otherwise",
    ),
    "another name at the member": (renamed(zipped(("data", b"1"))), "or a damaged one"),
}


@pytest.mark.parametrize("what", READ_OTHERWISE)
def test_an_archive_that_another_reader_reads_otherwise_is_refused(what: str) -> None:
    assert Archive(HONEST, "honest.zip").members == {"data": b"one", "more": b"two"}
    content, why = READ_OTHERWISE[what]
    with pytest.raises(UserError, match=why):
        Archive(content, "crafted.zip")


def test_two_members_of_one_name_are_refused() -> None:
    with pytest.warns(UserWarning, match="Duplicate"):
        content = zipped(("data", b"one"), ("data", b"two"))
    with pytest.raises(UserError, match="two of its members have the same name"):
        Archive(content, "twice.zip")
