"""One small network in each form in which tools export detectors: the same boxes and the same scores of a stop sign."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from cavbench.core.pair import choose
from cavbench.detection.boxes import confidence
from cavbench.detection.trial import try_detector
from cavbench.detection.victims import coco
from cavbench.detection.victims.in_process import detector as detector_of
from cavbench.detection.victims.layout import layout_of, named, split
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError
from tests.detection.victims.test_from_file import NAMES, RedCells, load, torch_file
from tests.plugins.toy_camera import RedStreet

SIDE, SIGN = 32, 1
SIZES = torch.tensor([float(SIDE)] * 4)


def picture() -> Tensor:
    """A red sign in the lower right corner of a grey image, and the same a little darker."""
    found = torch.full((2, 3, SIDE, SIDE), 0.5)
    found[:, :, 16:, 16:] = torch.tensor([1.0, 0.0, 0.0])[:, None, None]
    return found * torch.tensor([1.0, 0.9])[:, None, None, None]


def centred(boxes: Tensor) -> Tensor:
    return torch.cat(((boxes[..., :2] + boxes[..., 2:]) / 2, boxes[..., 2:] - boxes[..., :2]), -1)


def best(boxes: Tensor, scores: Tensor, first: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """The five best predictions, with labels from `first` on."""
    sure, labels = scores.max(-1)
    sure, place = sure.topk(5, 1)
    return boxes.gather(1, place.unsqueeze(-1).expand(-1, -1, 4)), sure, labels.gather(1, place) + first


def categories(scores: Tensor, count: int, number: int) -> Tensor:
    """The scores of the stop sign among those of COCO's categories."""
    return nn.functional.pad(scores[..., SIGN:], (number, count - number - 1))


class Wrapped(RedCells):
    """`RedCells` with its outputs in another form."""

    def __init__(self, form: Callable[[Tensor, Tensor], Any]) -> None:
        super().__init__()
        self.form = form

    def forward(self, pictures: Tensor) -> Any:
        return self.form(*super().forward(pictures))


def end_to_end(boxes: Tensor, scores: Tensor) -> Tensor:
    found, sure, labels = best(boxes, scores)
    return torch.cat((found, torch.stack((sure, labels.to(sure)), -1)), -1)


def labelled(boxes: Tensor, scores: Tensor) -> tuple[Tensor, ...]:
    found, sure, labels = best(boxes, scores)
    return labels, found, sure


def tensorflow(boxes: Tensor, scores: Tensor) -> tuple[Tensor, ...]:
    """Four outputs: y first, in shares, classes as floats by their category, and more rows than predictions."""
    found, sure, labels = best(boxes, scores)
    shares = (found / SIZES)[..., [1, 0, 3, 2]]
    classes = torch.where(labels == SIGN, 13.0, 3.0)
    rest = nn.functional.pad(sure, (0, 2), value=0.9)
    count = torch.ones_like(sure).sum(-1)
    return nn.functional.pad(shares, (0, 0, 0, 2)), nn.functional.pad(classes, (0, 2), value=13.0), rest, count


def logits(boxes: Tensor, scores: Tensor) -> tuple[Tensor, Tensor]:
    return scores.logit(), centred(boxes) / SIZES


def softmax(boxes: Tensor, scores: Tensor) -> tuple[Tensor, Tensor]:
    """As DETR: the last class is that there is none."""
    sign = categories(scores, 92, 13) * 0.999 + 1e-9
    none = 1 - sign.sum(-1, keepdim=True)
    return torch.cat((sign[..., :-1], none), -1).log(), centred(boxes) / SIZES


def inverted(boxes: Tensor, scores: Tensor) -> tuple[Tensor, Tensor]:
    """Some boxes that no threshold keeps have a negative width."""
    poor = torch.tensor([20.0, 20.0, 10.0, 10.0]).expand(boxes.shape[0], 3, 4)
    return torch.cat((boxes, poor), 1), nn.functional.pad(scores, (0, 0, 0, 3), value=0.004)


FORMS: dict[str, tuple[Callable[[Tensor, Tensor], Any], dict[str, str]]] = {
    "two outputs": (lambda boxes, scores: (boxes, scores), {}),
    "two outputs, scores first": (lambda boxes, scores: (scores, boxes), {}),
    "[1, 84, K]": (lambda boxes, scores: torch.cat((centred(boxes), scores), -1).mT, {}),
    "[1, K, 84]": (lambda boxes, scores: torch.cat((centred(boxes), scores), -1), {}),
    "[1, K, 85]": (lambda boxes, scores: torch.cat((centred(boxes), torch.ones_like(scores[..., :1]), scores), -1), {}),
    "[1, K, 6]": (end_to_end, {"names": f"{NAMES}+bus"}),
    "labels, boxes, scores": (labelled, {}),
    "boxes, scores, labels": (lambda boxes, scores: best(boxes, scores), {}),
    "TensorFlow": (tensorflow, {"names": "coco91", "normalised": "true"}),
    "logits": (logits, {"activation": "sigmoid", "normalised": "true", "boxes": "centre"}),
    "softmax": (softmax, {"names": "", "activation": "softmax", "normalised": "true", "boxes": "centre"}),
    "91 classes": (lambda boxes, scores: (boxes, categories(scores, 91, 13)), {"names": ""}),
    "90 classes": (lambda boxes, scores: (boxes, categories(scores, 90, 12)), {"names": ""}),
    "80 classes": (lambda boxes, scores: (boxes, categories(scores, 80, 11)), {"names": ""}),
    "inverted": (inverted, {}),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_has_the_same_scores(form: str, tmp_path: Path) -> None:
    wrap, values = FORMS[form]
    path = torch_file(tmp_path / "wrapped.pt2", Wrapped(wrap))
    detector = load(path, **{"names": NAMES, **values})
    boxes, scores = RedCells()(picture())
    wanted = scores[..., SIGN].amax(-1)
    place = boxes.gather(1, scores[..., SIGN].argmax(-1)[:, None, None].expand(-1, 1, 4))[:, 0]
    leaf = picture().requires_grad_()
    found = detector(leaf)
    label = detector.index("stop sign")
    # A softmax has a place for every other class.
    tolerance = 2e-3 if form == "softmax" else 1e-5
    torch.testing.assert_close(found.scores_of(label).amax(-1), wanted, rtol=0, atol=tolerance)
    sure = confidence(found, label, place, iou=0.99)
    torch.testing.assert_close(sure, wanted, rtol=0, atol=tolerance)
    assert bool(torch.autograd.grad(found.scores_of(label).sum(), leaf)[0].any())


class LastChannels(Wrapped):
    """As TensorFlow's detectors: images [N, H, W, 3], here in bytes."""

    def forward(self, pictures: Tensor) -> Any:
        return super().forward(pictures.permute(0, 3, 1, 2) / 255)


def test_a_program_takes_channels_last(tmp_path: Path) -> None:
    sample = torch.rand(2, SIDE, SIDE, 3)
    network = LastChannels(lambda boxes, scores: (boxes, scores))
    program = torch.export.export(network, (sample,), dynamic_shapes=({0: torch.export.Dim("batch")},))
    torch.export.save(program, tmp_path / "last.pt2")
    found = load(str(tmp_path / "last.pt2"), scaling="byte")(picture())
    torch.testing.assert_close(found.scores, RedCells()(picture())[1])


def onnx_of(path: Path, wrap: Callable[[Tensor, Tensor], Any], *, bytes_last: bool = False, sizes: bool = False) -> str:
    """`RedCells` in a form as ONNX: perhaps with an input [1, 32, 32, 3] of bytes, or with RT-DETR's second input."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    node, value = onnx.helper.make_node, onnx.helper.make_tensor_value_info
    network = RedCells()
    constants = {
        "k": network.kernel.weight,
        "c": network.kernel.bias,
        "b": network.boxes[None],
        "flat": torch.tensor([1, 2, -1]),
    }
    shape = [1, SIDE, SIDE, 3] if bytes_last else [1, 3, SIDE, SIDE]
    nodes = [node("Identity", ["pictures"], ["x"])]
    if bytes_last:
        constants["255"] = torch.tensor(255.0)
        nodes = [
            node("Cast", ["pictures"], ["float"], to=1),
            node("Div", ["float", "255"], ["unit"]),
            node("Transpose", ["unit"], ["x"], perm=[0, 3, 1, 2]),
        ]
    nodes += [
        node("Conv", ["x", "k", "c"], ["cells"], strides=[8, 8]),
        node("Reshape", ["cells", "flat"], ["flattened"]),
        node("Transpose", ["flattened"], ["logits"], perm=[0, 2, 1]),
        node("Sigmoid", ["logits"], ["all"]),
        node("ReduceMax", ["all"], ["scores"], axes=[2], keepdims=0),
        node("ArgMax", ["all"], ["labels"], axis=2, keepdims=0),
    ]
    if sizes:
        constants["32"] = torch.tensor(float(SIDE))
        nodes += [
            node("Cast", ["orig_target_sizes"], ["size"], to=1),
            node("Concat", ["size", "size"], ["four"], axis=1),
            node("Mul", ["b", "four"], ["scaled"]),
            node("Div", ["scaled", "32"], ["boxes"]),
        ]
    else:
        nodes.append(node("Identity", ["b"], ["boxes"]))
    inputs = [value("pictures", 2 if bytes_last else 1, shape), *[value("orig_target_sizes", 7, [1, 2])] * sizes]
    outputs = [value("labels", 7, None), value("boxes", 1, None), value("scores", 1, None)]
    initial = [onnx.numpy_helper.from_array(one.detach().numpy(), name) for name, one in constants.items()]
    graph = onnx.helper.make_graph(nodes, "detector", inputs, outputs, initial)
    made = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=9)
    path.write_bytes(made.SerializeToString())
    return str(path)


@pytest.mark.parametrize("given", [{"bytes_last": True}, {"sizes": True}])
def test_an_onnx_file_takes_bytes_with_channels_last_or_the_sizes_of_the_images(
    given: dict[str, bool], tmp_path: Path
) -> None:
    """As TensorFlow's detectors, and as RT-DETR's own export."""
    found = load(onnx_of(tmp_path / "net.onnx", best, **given))(picture())
    boxes, scores = RedCells()(picture())
    torch.testing.assert_close(
        found.scores_of(SIGN), torch.where(scores[..., 1] > scores[..., 0], scores[..., 1], 0.0), atol=2e-3, rtol=0
    )
    torch.testing.assert_close(found.boxes, boxes)


def test_what_is_wrong_is_said_in_one_line_with_all_that_must_be_typed(tmp_path: Path) -> None:
    path = torch_file(tmp_path / "logits.pt2", Wrapped(logits))
    with pytest.raises(UserError) as raised:
        load(path)
    for words in (
        "victim.activation=sigmoid",
        "victim.normalised=true",
        "set victim.boxes=centre",
        "x2 < x1 or y2 < y1",
    ):
        assert words in str(raised.value)


def test_labels_are_told_from_scores_by_type_then_by_whole_numbers() -> None:
    boxes, sure = torch.rand(1, 5, 4), torch.tensor([[0.9, 0.5, 0.0, 0.0, 0.0]])
    labels = torch.tensor([[1, 1, 0, 0, 0]])
    for outputs in ([labels, boxes, sure], [sure, labels.float(), boxes], [boxes, labels, torch.zeros_like(sure)]):
        layout = layout_of([one.shape for one in outputs], 2)
        assert layout == "apart"
        found, objectness, classes = split(outputs, layout, 2)
        assert torch.equal(found, boxes)
        assert torch.equal(classes[0, :, 1], labels[0].float())
        assert torch.equal(
            objectness, outputs[0] if outputs[0].is_floating_point() and outputs[0].ndim == 2 else outputs[2]
        )
    with pytest.raises(UserError, match="neither of the two outputs"):
        split([boxes, sure, sure + 0.1], "apart", 2)


def test_a_run_says_which_numbering_is_meant_before_it_begins(tmp_path: Path) -> None:
    """The labels are COCO's categories, and were read as its 80 classes."""

    def wrap(boxes: Tensor, scores: Tensor) -> tuple[Tensor, ...]:
        found, sure, labels = best(boxes, scores)
        return found, sure, torch.where(labels == SIGN, 13, 3)

    victim = choose("victim", "detector", path=torch_file(tmp_path / "net.pt2", Wrapped(wrap)), frame=SIDE).component
    (said,) = try_detector(victim.load(0, RedStreet().facts), victim, RedStreet(), alone=True)
    assert said.startswith(
        "sees no stop sign in 4 clear, near frames without a patch; with victim.names=coco91 it has "
    )


def test_numberings_of_coco_follow_from_the_number_of_classes() -> None:
    for name, names in coco.NUMBERINGS.items():
        assert named([(1, 9, 4), (1, 9, len(names))]) == names, name
        assert names.index("stop sign") == {"coco80": 11, "coco91": 13, "coco90": 12, "coco92": 13}[name]
    assert named([(1, 300, 6)]) == coco.NAMES


def dictionary(boxes: Tensor, scores: Tensor) -> list[dict[str, Tensor]]:
    """As torchvision: a mapping for each image, with as many predictions as it has."""
    found, sure, labels = best(boxes, scores)
    kept = sure > 0.3
    return [{"boxes": found[n, k], "labels": labels[n, k], "scores": sure[n, k]} for n, k in enumerate(kept)]


def logits_by_name(boxes: Tensor, scores: Tensor) -> dict[str, Tensor | None]:
    """As DETR and its descendants in a well-known library."""
    return {"loss": None, "logits": scores.logit(), "pred_boxes": centred(boxes) / SIZES}


@pytest.mark.parametrize(
    ("wrap", "reading"),
    [
        (lambda boxes, scores: (boxes, scores), {}),
        (logits_by_name, {"activation": "sigmoid", "normalised": True, "boxes": "centre"}),
        (dictionary, {}),
        (lambda boxes, scores: (torch.cat((centred(boxes), scores), -1).mT, [boxes]), {}),
    ],
)
def test_a_module_of_the_session_is_read_alike(wrap: Callable[[Tensor, Tensor], Any], reading: dict[str, Any]) -> None:
    module = Wrapped(wrap).train()
    victim = detector_of(Anywhere(module), names=NAMES, **reading)
    assert module.training
    found = victim.load(0, StopSignApproach().facts)(picture())
    wanted = RedCells()(picture())[1][..., SIGN].amax(-1)
    torch.testing.assert_close(found.scores_of(SIGN).amax(-1), wanted)
    assert victim.answers == "gradients"


def test_a_softmax_over_named_classes_may_have_one_more_for_no_object() -> None:
    """As a DETR has that was trained on classes of one's own."""

    def wrap(boxes: Tensor, scores: Tensor) -> dict[str, Tensor]:
        shares = torch.cat((scores / 2, 1 - scores.sum(-1, keepdim=True) / 2), -1)
        return {"logits": shares.clamp_min(1e-9).log(), "pred_boxes": centred(boxes) / SIZES}

    reading: dict[str, Any] = {"activation": "softmax", "normalised": True, "boxes": "centre"}
    victim = detector_of(Anywhere(Wrapped(wrap)), names=NAMES, **reading)
    found = victim.load(0, StopSignApproach().facts)
    sure = found(picture()).scores_of(SIGN).amax(-1)
    torch.testing.assert_close(sure, RedCells()(picture())[1][..., SIGN].amax(-1) / 2)
    with pytest.raises(UserError, match=r"with 2 classes \(victim.names\) it must return"):
        detector_of(Anywhere(Wrapped(wrap)), names=NAMES, **(reading | {"activation": "sigmoid"}))


def test_wrong_settings_of_a_module_are_told_before_a_run() -> None:
    class Bytes(Anywhere):
        def forward(self, pictures: Tensor) -> Any:
            return super().forward(pictures / 255)

    victim = detector_of(Bytes(RedCells()), names=NAMES)
    (said,) = try_detector(victim.load(0, RedStreet().facts), victim, RedStreet(), alone=True)
    assert "with scaling='byte' it has 1.00" in said
    assert detector_of(victim.load(0, RedStreet().facts)).alternatives() == {}


class Anywhere(nn.Module):
    """A network that takes images of any size: it looks at their upper left corner."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, pictures: Tensor) -> Any:
        return self.network(pictures[..., :SIDE, :SIDE])


def test_a_module_without_a_gradient_is_a_black_box_and_a_wrong_one_is_told_how_to_be_read() -> None:
    quiet = detector_of(Anywhere(Wrapped(lambda boxes, scores: (boxes, scores.detach()))), names=NAMES)
    assert quiet.answers == "scores"
    with pytest.raises(UserError, match=r"set normalised=True; cavbench.detector\(network, boxes=…"):
        detector_of(Anywhere(Wrapped(lambda boxes, scores: (boxes / SIDE, scores))), names=NAMES)
    with pytest.raises(
        UserError, match=r"Linear fails on 1 image of 320 x 320: RuntimeError fails \(RuntimeError: mat1"
    ):
        detector_of(nn.Linear(3, 4))
    with pytest.raises(UserError, match="how to read Wrapped: boxes must be one of"):
        detector_of(Wrapped(best), boxes="middle")
