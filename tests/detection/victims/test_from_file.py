"""Detectors in files of users: they predict like the exported network, and a file that does not fit is refused in one line."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cavbench.attacks.detection.square_patch import SquarePatch
from cavbench.core.pair import choose
from cavbench.detection import Detector, PatchThreat
from cavbench.detection.crafting import craft
from cavbench.detection.sight import look
from cavbench.detection.victims.file_network import DEVIATION, GREY, MEAN, FileDetector, Input, Order, Output, Scaling
from cavbench.detection.victims.layout import Layout, layout_of, split
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError
from cavbench.formats.torch_operations import operation
from cavbench.formats.trial import RefusedError
from cavbench.run.config import component, plan_of
from tests.checks.rules import broken
from tests.plugins.toy_camera import RedScenes

FACTS = StopSignApproach().facts
NAMES = "car+stop sign"
CELL, STEP = 16, 8


class RedCells(nn.Module):
    """A detector as a user would export it: a box for every window of 16 pixels, its score is high for red."""

    def __init__(self, size: tuple[int, int] = (32, 32)) -> None:
        super().__init__()
        self.kernel = nn.Conv2d(3, 2, CELL, STEP)
        with torch.no_grad():
            noise = torch.randn(self.kernel.weight.shape, generator=torch.Generator().manual_seed(0))
            red = torch.tensor([[1.0, 1.0, 1.0], [8.0, -4.0, -4.0]])[:, :, None, None]
            self.kernel.weight.copy_((red + 0.1 * noise) / CELL**2)
            self.kernel.bias.copy_(torch.tensor([-3.0, -1.0]))
        rows, columns = (torch.arange(0, side - CELL + 1, STEP) for side in size)
        top, left = torch.meshgrid(rows, columns, indexing="ij")
        self.boxes: Tensor
        self.register_buffer("boxes", torch.stack((left, top, left + CELL, top + CELL), -1).flatten(0, 1).float())
        self.eval()

    def forward(self, pictures: Tensor) -> tuple[Tensor, ...]:
        scores = self.kernel(pictures).flatten(2).sigmoid().transpose(1, 2)
        return self.boxes.to(scores).expand(pictures.shape[0], -1, -1), scores


class Changed(RedCells):
    """`RedCells` whose outputs are changed by a function."""

    def __init__(self, change: Callable[[Tensor, Tensor], Any]) -> None:
        super().__init__()
        self.change = change

    def forward(self, pictures: Tensor) -> Any:
        return self.change(*super().forward(pictures))


def torch_file(path: Path, network: nn.Module | None = None, dtype: torch.dtype = torch.float32) -> str:
    network = (network or RedCells()).to(dtype)
    sample = torch.rand(2, 3, 32, 32, dtype=dtype)
    program = torch.export.export(network, (sample,), dynamic_shapes=({0: torch.export.Dim("batch")},))
    torch.export.save(program, path)
    return str(path)


BOXES = np.array([[[0, 0, 16, 16], [8, 8, 24, 24], [10, 10, 31, 31]]], np.float32)
SCORES = np.array([[[0.9, 0.2], [0.1, 0.8], [0.5, 0.5]]], np.float32)


def onnx_file(
    path: Path,
    *,
    boxes: np.ndarray = BOXES,
    scores: np.ndarray = SCORES,
    shape: tuple[int | str, ...] = ("n", 3, "h", "w"),
    dtype: int = 1,
    inputs: tuple[str, ...] = ("pictures",),
    outputs: tuple[str, ...] = ("boxes", "scores"),
    shared: bool = False,
    counted: bool = False,
) -> str:
    """A detector whose boxes are constant and whose scores are multiples of a sigmoid of the image's mean.

    Args:
        shared: the mean is that of the batch.
        counted: it has one more prediction for each image with a bright pixel.
    """
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    node = onnx.helper.make_node
    constants = {"b": boxes, "s": scores, "flat": np.array([-1, 1, 1]), "zero": np.zeros(1, np.float32)}
    nodes = [
        node("Cast", inputs[:1], ["x"], to=1),
        node("ReduceMean", ["x"], ["own"], axes=[1, 2, 3]),
        node("ReduceMean", ["x"], ["all"], axes=[0, 1, 2, 3]),
        node("Reshape", ["all" if shared else "own", "flat"], ["mean"]),
        node("Reshape", ["own", "flat"], ["each"]),
        node("Mul", ["each", "zero"], ["none"]),
        node("Add", ["none", "mean"], ["of_each"]),
        node("Sigmoid", ["of_each"], ["sure"]),
    ]
    if counted:
        constants |= {"limit": np.full(1, 0.9, np.float32), "one": np.array([1])}
        nodes += [
            node("ReduceMax", ["x"], ["most"], axes=[1, 2, 3]),
            node("Greater", ["most", "limit"], ["bright"]),
            node("NonZero", ["bright"], ["places"]),
            node("Shape", ["places"], ["count"], start=1),
            node("Add", ["count", "one"], ["k"]),
            node("Concat", ["one", "k", "one"], ["size"], axis=0),
            node("Expand", ["b", "size"], ["bs"]),
            node("Expand", ["s", "size"], ["ss"]),
        ]
    nodes += [
        node("Add", ["none", "bs" if counted else "b"], ["boxes"]),
        node("Mul", ["sure", "ss" if counted else "s"], ["scores"]),
        node("Concat", ["boxes", "scores"], ["rows"], axis=2),
        node("Transpose", ["rows"], ["columns"], perm=[0, 2, 1]),
    ]
    value = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        nodes,
        "detector",
        [value(name, dtype, list(shape)) for name in inputs],
        [value(name, 1, None) for name in outputs],
        [onnx.numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    made = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=9)
    path.write_bytes(made.SerializeToString())
    return str(path)


def load(path: str, names: str = NAMES, **values: str) -> FileDetector:
    given = {"path": path, "frame": "32"} | ({"names": names} if names else {}) | values
    return component("victim", "detector", given).load(0, FACTS)


def refusal(path: str, names: str = NAMES, **values: str) -> str:
    with pytest.raises(UserError) as raised:
        load(path, names, **values)
    line = str(raised.value)
    assert "\n" not in line
    assert len(line) < 500
    return line


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("detectors")


@pytest.fixture(scope="module")
def program(folder: Path) -> str:
    return torch_file(folder / "red.pt2")


@pytest.fixture(scope="module")
def black_box(folder: Path) -> str:
    return onnx_file(folder / "red.onnx")


class Exported(nn.Module):
    """A detector of cavbench as a network with two outputs."""

    def __init__(self, detector: Detector) -> None:
        super().__init__()
        self.detector = detector

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        found = self.detector.predict(pictures)
        return found.boxes, found.scores


@pytest.mark.slow
def test_the_zoos_yolov5_answers_the_same_from_both_kinds_of_files(tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    detector = choose("victim", "yolov5").component.load(0, FACTS)
    sample = torch.rand(2, 3, 64, 96)
    program = torch.export.export(Exported(detector), (sample,), dynamic_shapes=({0: torch.export.Dim("batch")},))
    torch.export.save(program, tmp_path / "yolo.pt2")
    torch.onnx.export(program, (), tmp_path / "yolo.onnx", external_data=False, verbose=False)
    street = StopSignApproach().training_scenes()
    x, y = (street.boxes[20].view(2, 2).mean(0) - torch.tensor([48, 32])).int().tolist()
    pictures = street.windows(
        torch.tensor([20, 20, 20]), None, 1.0, torch.tensor([[x, y], [x + 9, y], [0, 0]]), (64, 96)
    )
    wanted = detector(pictures)
    assert wanted.scores.max() > 0.3
    for name, scores, boxes in (("yolo.pt2", 1e-6, 1e-4), ("yolo.onnx", 1e-4, 1e-2)):
        loaded = load(str(tmp_path / name), "+".join(detector.names), frame="96")
        with torch.no_grad():
            found = loaded(pictures)
        torch.testing.assert_close(found.scores, wanted.scores, rtol=0, atol=scores)
        torch.testing.assert_close(found.boxes, wanted.boxes, rtol=0, atol=boxes)
        assert loaded.weights_sha256


def test_victims_from_detector_files_keep_the_rules(program: str, black_box: str) -> None:
    assert broken("victim", "detector", path=program, names=NAMES, frame="32") == {}
    assert broken("victim", "detector", path=black_box, names=NAMES) == {}


def test_a_gradient_goes_through_a_program_and_its_border(program: str) -> None:
    pictures = torch.rand(3, 3, 20, 32, generator=torch.Generator().manual_seed(0)).requires_grad_()
    scores = load(program)(pictures).scores_of(1)
    (own,) = torch.autograd.grad(scores.sum(), pictures)
    fitted = nn.functional.pad(pictures, (0, 0, 6, 6), value=GREY)
    wanted = RedCells()(fitted)[1][..., 1]
    torch.testing.assert_close(scores, wanted)
    torch.testing.assert_close(own, torch.autograd.grad(wanted.sum(), pictures)[0])


def test_a_gradient_attack_on_an_onnx_detector_is_refused_before_any_work() -> None:
    with pytest.raises(UserError, match="victim 'detector' is a black box that supports 'scores' at most"):
        plan_of(["attack=eot", "victim=detector", "victim.path=nowhere.onnx"])
    plan_of(["attack=noise_patch", "victim=detector", "victim.path=nowhere.onnx"])
    plan_of(["attack=eot", "victim=detector", "victim.path=nowhere.pt2"])
    plan_of(["attack=square_patch", "victim=detector", "victim.path=nowhere.onnx"])
    sent = pickle.loads(pickle.dumps(choose("victim", "detector", path="nowhere.onnx").component))
    assert (sent.answers, sent.libraries) == ("scores", ("onnxruntime",))


def test_a_black_box_is_attacked_by_its_scores(black_box: str) -> None:
    """Its scores rise with the mean of the image, so the best patch is black."""
    detector, scenes = load(black_box), RedScenes(torch.linspace(30, 8, 5))
    attack = SquarePatch(texels=8, steps=200, views=2, renew=100, window=32)
    threat = PatchThreat(budget=0.9)
    made = craft(attack, detector, scenes, threat, attack_seed=0, progress=lambda share, text: None)
    assert (made.queries, made.gradients) == (2 * (200 + 2), 0)
    assert made.texels is not None
    grey, patched = (look(detector, scenes, one, 0.9).confidence.mean() for one in (made.texels * 0 + 0.5, made.texels))
    assert patched < grey
    assert made.texels.mean() < 0.3


def made(
    network: Callable[[Tensor], Any],
    *,
    batch: int | None = None,
    size: tuple[int, int] | None = (64, 64),
    frame: int = 128,
    scaling: Scaling = "unit",
    order: Order = "rgb",
) -> FileDetector:
    given = Input(batch, size, torch.float32, frame, scaling, order)
    return FileDetector(network, "file", ("car", "stop sign"), given, Output("auto", False), "")


def test_images_are_fitted_to_a_fixed_size_and_boxes_to_the_images() -> None:
    shown = []

    def network(pictures: Tensor) -> tuple[Tensor, Tensor]:
        shown.append(pictures)
        boxes = torch.tensor([[0.0, 16, 64, 48], [16, 20, 32, 28]]).expand(len(pictures), -1, -1)
        return boxes, torch.full((len(pictures), 2, 2), 0.5)

    wide = torch.full((2, 3, 64, 128), 0.25)
    found = made(network)(wide)
    assert shown[0].shape == (2, 3, 64, 64)
    torch.testing.assert_close(shown[0][:, :, 16:48], torch.full((2, 3, 32, 64), 0.25))
    torch.testing.assert_close(shown[0][:, :, [0, 15, 48, 63]], torch.full((2, 3, 4, 64), GREY))
    torch.testing.assert_close(found.boxes[1], torch.tensor([[0.0, 0, 128, 64], [32, 8, 64, 24]]))
    # A window of 64 pixels is shown at the scale of the whole image.
    made(network)(wide[:, :, :, :64])
    assert (shown[1][0, 0] != GREY).nonzero().aminmax(dim=0).max.tolist() == [47, 47]
    assert (shown[1][0, 0] != GREY).sum() == 32 * 32
    # An image larger than the frame is shown whole.
    made(network)(torch.full((1, 3, 64, 512), 0.25))
    assert (shown[2][0, 0] != GREY).sum() == 8 * 64


def test_pixels_are_scaled_and_ordered_as_the_parameters_say() -> None:
    shown = []

    def network(pictures: Tensor) -> tuple[Tensor, Tensor]:
        shown.append(pictures)
        return torch.zeros(1, 1, 4), torch.zeros(1, 1, 2)

    picture = torch.rand(1, 3, 32, 32)
    for scaling, order in (("byte", "bgr"), ("imagenet", "rgb"), ("imagenet", "bgr")):
        made(network, size=None, scaling=scaling, order=order)(picture)  # type: ignore[arg-type]
    scaled = (picture[0] - torch.tensor(MEAN)[:, None, None]) / torch.tensor(DEVIATION)[:, None, None]
    for one, wanted in zip(shown, (picture[0].flip(0) * 255, scaled, scaled.flip(0)), strict=True):
        torch.testing.assert_close(one[0], wanted)


def test_a_file_with_a_fixed_batch_size_is_asked_in_parts() -> None:
    def network(pictures: Tensor) -> tuple[Tensor, Tensor]:
        assert len(pictures) == 2
        return torch.zeros(2, 1, 4), pictures.mean((1, 2, 3)).view(2, 1, 1).expand(2, 1, 2)

    pictures = torch.rand(5, 3, 64, 64)
    found = made(network, batch=2, frame=64)(pictures)
    torch.testing.assert_close(found.scores_of(1)[:, 0], pictures.mean((1, 2, 3)))
    with pytest.raises(UserError, match="file fails on 1 image of 64 x 64: AssertionError fails"):
        made(network)(pictures[:1])


def test_every_layout_is_read_as_the_same_predictions() -> None:
    boxes, scores = torch.rand(2, 9, 4), torch.rand(2, 9, 3)
    sure = torch.rand(2, 9, 1)
    best = scores.argmax(-1, keepdim=True)
    rows = torch.cat((boxes, scores), -1)
    written: Mapping[Layout, tuple[list[Tensor], Tensor]] = {
        "boxes and scores": ([boxes, scores], scores),
        "scores and boxes": ([scores, boxes], scores),
        "rows": ([rows], scores),
        "columns": ([rows.transpose(1, 2)], scores),
        "objectness": ([torch.cat((boxes, sure, scores), -1)], sure * scores),
        "labelled": (
            [torch.cat((boxes, sure, best.float()), -1)],
            sure * nn.functional.one_hot(best[..., 0], 3),
        ),
    }
    for layout, (outputs, wanted) in written.items():
        assert layout_of([one.shape for one in outputs], 3) == layout
        found, objectness, classes = split(outputs, layout, 3)
        assert torch.equal(found, boxes)
        torch.testing.assert_close(objectness.unsqueeze(-1) * classes, wanted)
    (one,) = (layout_of([(2, 9), (2, 9, 4)], 1),)
    assert one == "scores and boxes"
    assert split([scores[..., 0], boxes], one, 1)[2].shape == (2, 9, 1)
    unknown = torch.cat((boxes, sure, torch.full((2, 9, 1), torch.nan)), -1)
    assert not split([unknown], "labelled", 3)[2].any()


@pytest.mark.parametrize(
    "shapes",
    [
        [(2, 9, 4)],
        [(2, 9, 4), (2, 8, 3)],
        [(9, 4), (9, 3)],
        [(2, 7, 8)],
        [(2, 7, 6)],
        [(2, 9, 9)],
        [(2, 9, 4)] * 3,
        [],
        [()],
    ],
)
def test_other_outputs_have_no_layout(shapes: list[tuple[int, ...]]) -> None:
    assert layout_of(shapes, 3) is None


def test_boxes_are_corners_or_centres_in_pixels_or_shares(tmp_path: Path) -> None:
    picture = torch.rand(1, 3, 64, 32)
    centres = np.array([[[16, 16, 32, 32], [16, 16, 16, 16], [20.5, 20.5, 21, 21]]], np.float32)
    wanted = torch.tensor([[[0.0, 0, 32, 32], [8, 8, 24, 24], [10, 10, 31, 31]]])
    given = [
        ({"boxes": centres, "outputs": ("rows",)}, {}),
        ({"boxes": centres, "outputs": ("columns",)}, {}),
        ({"boxes": centres}, {"boxes": "centre"}),
        ({"boxes": wanted.numpy(), "outputs": ("scores", "boxes")}, {}),
        ({"boxes": wanted.numpy() / np.float32([32, 64, 32, 64])}, {"normalised": "true"}),
    ]
    for number, (file, values) in enumerate(given):
        path = onnx_file(tmp_path / f"{number}.onnx", **file)  # type: ignore[arg-type]
        torch.testing.assert_close(load(path, **values)(picture).boxes, wanted)


REFUSED: dict[str, tuple[dict[str, Any], dict[str, str], str]] = {
    "no box": (
        {"boxes": BOXES[:, :0], "scores": SCORES[:, :0]},
        {},
        "returns 0 boxes for an image; from 1 to 200000 are allowed",
    ),
    "more boxes than fit": (
        {"boxes": BOXES[:, :1].repeat(200_001, 1), "scores": SCORES[:, :1].repeat(200_001, 1)},
        {},
        "returns 200001 boxes",
    ),
    "one for a bright image": (
        {"boxes": BOXES[:, :1], "scores": SCORES[:, :1], "counted": True},
        {},
        "returns 2 boxes for one image and 1 for another: export it without non-maximum suppression",
    ),
    "another number of classes": (
        {},
        {"names": "stop sign"},
        "returns [1, 3, 4] and [1, 3, 2] for 1 image; with 1 classes (victim.names) it must return boxes [N, K, 4] and scores",
    ),
    "COCO": ({}, {"names": ""}, "with 80 classes (victim.names) it must return boxes [N, K, 4] and scores [N, K, 80]"),
    "four outputs": ({"outputs": ("boxes", "scores", "rows", "sure")}, {}, "returns [1, 3, 4] and [1, 3, 2] and"),
    "boxes alone": ({"outputs": ("boxes",)}, {}, "returns [1, 3, 4] for 1 image"),
    "logits": (
        {"scores": 9 * SCORES},
        {},
        "they must be in [0, 1]: if they are logits, set victim.activation=sigmoid or victim.activation=softmax",
    ),
    "NaN": ({"scores": np.full_like(SCORES, np.nan)}, {}, "returns boxes or scores that are NaN or infinite"),
    "infinite boxes": ({"boxes": BOXES + np.inf}, {}, "returns boxes or scores that are NaN or infinite"),
    "the batch": ({"shared": True}, {}, "returns other scores for an image if other images are in its batch"),
    "shares": ({"boxes": BOXES / 32}, {}, "whose coordinates are at most 0.969: set victim.normalised=true"),
    "pixels": ({}, {"normalised": "true"}, "far beyond the image: leave out victim.normalised=true"),
    "centres": (
        {"boxes": BOXES[..., [2, 3, 0, 1]]},
        {},
        "x2 < x1 or y2 < y1: if they are [x, y, width, height], set victim.boxes=centre",
    ),
    "two inputs": (
        {"inputs": ("pictures", "size")},
        {},
        "takes pictures tensor(float), size tensor(float); it must take one",
    ),
    "signed bytes": ({"dtype": 3}, {}, "takes pictures tensor(int8); it must take one tensor(float)"),
    "double": ({"dtype": 11}, {}, "takes pictures tensor(double)"),
    "text": ({"dtype": 8}, {}, "takes pictures tensor(string)"),
    "channels between": (
        {"shape": (1, 32, 3, 32)},
        {},
        "takes [1, 32, 3, 32]; a detector takes images [N, 3, H, W] or",
    ),
    "half dynamic": ({"shape": ("n", 3, 32, "w")}, {}, "takes [any, 3, 32, any]; a detector takes images"),
    "a street": ({"shape": ("n", 3, 10**6, 10**6)}, {}, "with H and W both fixed, up to 4096, or both dynamic"),
    "a crowd": ({"shape": (10**9, 3, 32, 32)}, {}, "N up to 64 or dynamic"),
    "no stop sign": (
        {},
        {"names": "car+stop"},
        "none of the classes in victim.names is 'stop sign', which attacks hide",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_a_file_that_is_no_such_detector_is_refused_in_one_line(what: str, tmp_path: Path) -> None:
    file, values, part = REFUSED[what]
    assert part in refusal(onnx_file(tmp_path / "bad.onnx", **file), **values)


PROGRAMS: dict[str, tuple[Callable[[Path], str], str]] = {
    "no gradient": (
        lambda path: torch_file(path, Changed(lambda boxes, scores: (boxes, scores.detach()))),
        "has no gradient from its scores to the pixels: export it without torch.no_grad",
    ),
    "rounded": (
        lambda path: torch_file(path, Changed(lambda boxes, scores: (boxes, scores.round()))),
        "has no gradient from its scores to the pixels",
    ),
    "double": (
        lambda path: torch_file(path, dtype=torch.float64),
        "takes torch.float64; a detector takes float32 or float16",
    ),
    "a number": (
        lambda path: torch_file(path, Changed(lambda boxes, scores: (boxes, scores, 3))),
        "is refused: it returns something that is no tensor",
    ),
    "the batch": (
        lambda path: torch_file(path, Changed(lambda boxes, scores: (boxes, scores * scores.mean()))),
        "returns other scores for an image if other images are in its batch",
    ),
    "NaN": (
        lambda path: torch_file(path, Changed(lambda boxes, scores: (boxes, (scores - 2).sqrt()))),
        "NaN or infinite",
    ),
}


@pytest.mark.parametrize("what", PROGRAMS)
def test_a_program_that_is_no_such_detector_is_refused_in_one_line(what: str, tmp_path: Path) -> None:
    make, part = PROGRAMS[what]
    assert part in refusal(make(tmp_path / "bad.pt2"))


def test_files_of_half_precision_are_scored(tmp_path: Path) -> None:
    pictures = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0)).requires_grad_()
    found = load(torch_file(tmp_path / "half.pt2", dtype=torch.float16))(pictures)
    assert found.scores.dtype == torch.float32
    torch.testing.assert_close(found.scores, RedCells()(pictures)[1], rtol=0, atol=2e-3)
    assert torch.autograd.grad(found.scores.sum(), pictures)[0].any()
    assert load(onnx_file(tmp_path / "half.onnx", dtype=10))(pictures).scores.shape == (2, 3, 2)


def test_a_truncated_file_is_refused(program: str, black_box: str, tmp_path: Path) -> None:
    for path in map(Path, (program, black_box)):
        content = path.read_bytes()
        for share in (0.0, 0.3, 0.9, 0.999):
            cut = tmp_path / f"cut{path.suffix}"
            cut.write_bytes(content[: int(share * len(content))])
            assert "cannot be read: it is not " in refusal(str(cut))
    (tmp_path / "text.onnx").write_text("nothing of the kind")
    assert "cannot be read" in refusal(str(tmp_path / "text.onnx"))
    assert "there is no file" in refusal(str(tmp_path / "nothing.pt2"))
    assert "path must end with .onnx or .pt2, got 'net.engine': export the detector to .onnx" in refusal("net.engine")
    assert "a TensorFlow.js graph is victim=tfjs" in refusal("model.json")


def test_a_pickle_of_ultralytics_is_told_what_to_type_and_never_opened(tmp_path: Path) -> None:
    path = tmp_path / "best.pt"
    path.symlink_to("/dev/zero")
    line = refusal(str(path))
    assert "it holds a pickle, which is a program and is never opened" in line
    assert "`yolo export model=best.pt format=onnx imgsz=384,1248` writes best.onnx" in line


def test_an_operation_outside_of_the_list_is_refused(program: str, tmp_path: Path) -> None:
    from tests.formats.test_hostile_files import calls, rewritten

    harm, crafted = tmp_path / "harm", tmp_path / "crafted.pt2"
    rewritten(Path(program), crafted, calls("torch.os.mkdir", {"as_string": "HARM"}), harm)
    assert "is refused: it calls 'torch.os.mkdir'; only the operations of ATen" in refusal(str(crafted))
    assert not harm.exists()


def test_an_operation_that_onnx_runtime_does_not_have_is_refused(black_box: str, tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    model = onnx.load(black_box)
    model.graph.node[0].op_type, model.graph.node[0].domain = "Run", "com.example"
    model.opset_import.append(onnx.helper.make_opsetid("com.example", 1))
    onnx.save(model, tmp_path / "own.onnx")
    line = refusal(str(tmp_path / "own.onnx"))
    assert "it needs the operation com.example:Run, which ONNX Runtime does not have" in line


def test_an_image_is_resized_by_scales_that_fit_its_size_only() -> None:
    _, resize = operation("torch.ops.aten.upsample_nearest2d.default")
    _, by_scale = operation("torch.ops.aten.upsample_bilinear2d.vec")
    picture = torch.rand(1, 1, 8, 8)
    assert torch.equal(
        resize(picture, [16, 12], 2.0, 1.5), torch.ops.aten.upsample_nearest2d(picture, [16, 12], 2.0, 1.5)
    )
    assert by_scale(picture, None, False, [2.0, 1.5]).shape == (1, 1, 16, 12)
    for scale in (float("nan"), 1e-300, 1e300, -1.0, 0.5):
        with pytest.raises(RefusedError, match="by a scale that does not fit its size"):
            resize(picture, [16, 16], scale, 2.0)
    with pytest.raises(RefusedError):
        by_scale(picture, None, False, [1e-300, 2.0])


def test_class_names_come_from_a_file_and_are_part_of_the_hash(black_box: str, tmp_path: Path) -> None:
    listed = tmp_path / "labels.txt"
    listed.write_text("car\nstop sign\n")
    assert load(black_box, str(listed)).names == ("car", "stop sign")
    first = load(black_box, str(listed)).weights_sha256
    listed.write_text("stop sign\ncar\n")
    assert load(black_box, str(listed)).weights_sha256 != first
    listed.write_text("car\n\nstop sign")
    assert "has an empty name, or one that cannot be printed" in refusal(black_box, str(listed))
    listed.write_bytes(b"\xff\xfe\x00")
    assert "cannot be read: UnicodeDecodeError" in refusal(black_box, str(listed))


def test_without_onnx_runtime_the_error_has_the_install_command(
    black_box: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert "needs ONNX Runtime: pip install 'cavbench[onnx]'" in refusal(black_box, "stop sign+car")
