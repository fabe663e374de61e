"""The content of an approach's recording: frames with and without the patch, the detector's output, and the patch."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal

import cv2
import numpy as np
import pyarrow as pa
import rerun as rr
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.detection import Scenes, stopping
from cavbench.detection.approach import Sighting
from cavbench.detection.patch import Evolution
from cavbench.detection.recording import blueprint as approach_blueprint
from cavbench.detection.recording.blueprint import GAP, sights
from cavbench.detection.sight import Sight
from cavbench.recording.colours import EGO, GREY, MEASURED, SHOWN, Colour
from cavbench.recording.columns import Columns

COLOURS: dict[str, Colour] = {"with_patch": SHOWN, "without_patch": MEASURED}
LOSS_COLOURS: tuple[Colour, ...] = (SHOWN, MEASURED, EGO, GREY)
QUALITY = 60
"""JPEG quality of the frames, which are most of the file, and of the crafting steps of the patch."""
FAINT = 70
"""Opacity, from 0 to 255, of overlays on a bar chart."""
ROOM = 1.5
"""Height of a chart, relative to its highest bar; this leaves room for the legend."""

Array = NDArray[np.float64]


def log(sighting: Sighting, meta: Mapping[str, object], stream: rr.RecordingStream) -> None:
    """Send the frames, the detector's output on them, and the patch."""
    scenes = sighting.approach.scenes
    distance = scenes.distance.double().numpy()
    centimetres = -np.rint(100 * distance).astype(np.int64)
    columns = Columns(stream, {"frame": np.arange(len(scenes)), "distance_cm": centimetres})
    columns.note("about", approach_blueprint.page(sighting, meta))
    for name, sight in sights(sighting).items():
        texels = sighting.texels if name == "with_patch" else None
        _frames(columns, name, scenes, texels, sighting.share)
        _boxes(columns, name, scenes.boxes, sight)
    bars = {name: (sight.confidence.astype(np.float64), COLOURS[name]) for name, sight in sights(sighting).items()}
    _chart(columns, "confidence", distance, bars, highest=1.0)
    width = float(np.ptp(distance)) + 2
    threshold = rr.BarChart(
        [stopping.THRESHOLD], abscissa=[float(distance.min()) - 1], widths=[width], color=(*GREY, FAINT)
    )
    columns.fixed("confidence/threshold", threshold)
    if sighting.texels is not None:
        columns.fixed("patch/scored", rr.EncodedImage(contents=_coded(sighting.texels, "png"), media_type="image/png"))
    if sighting.patch and sighting.patch.evolution:
        _evolution(sighting.patch.evolution, stream)


def _frames(columns: Columns, path: str, scenes: Scenes, texels: Tensor | None, share: float) -> None:
    patches = texels.unsqueeze(0) if texels is not None else None
    with torch.no_grad():
        pictures = [scenes.render(frame, patches, share)[0] for frame in torch.arange(len(scenes)).split(1)]
    _images(columns, path, pictures)


def _boxes(columns: Columns, path: str, true: Tensor, sight: Sight) -> None:
    """Send the sign's true box, and the boxes of the detected stop signs with their scores."""
    columns.fixed(f"{path}/sign", rr.Boxes2D.from_fields(colors=[EGO], radii=[-0.75]))
    columns.send(f"{path}/sign", _corners(true).partition(np.ones(len(true), np.int64)))
    found = torch.cat([one.boxes for one in sight.found])
    labels = [f"{float(score):.2f}" for one in sight.found for score in one.scores]
    columns.fixed(f"{path}/found", rr.Boxes2D.from_fields(colors=[COLOURS[path]], radii=[-1.5], show_labels=True))
    lengths = np.array([len(one.scores) for one in sight.found])
    columns.send(f"{path}/found", _corners(found, labels=labels).partition(lengths))


def _corners(boxes: Tensor, **more: object) -> rr.ComponentColumnList:
    low, high = boxes.numpy()[:, :2], boxes.numpy()[:, 2:]
    return rr.Boxes2D.columns(centers=(low + high) / 2, half_sizes=(high - low) / 2, **more)


def _evolution(evolution: Evolution, stream: rr.RecordingStream) -> None:
    """Send the steps of the crafting: the patches on their own timeline and in a strip, and the losses as a chart."""
    steps = evolution.steps.numpy()
    columns = Columns(stream, {"crafting_step": steps})
    moments = evolution.texels / 255
    columns.fixed("patch/crafted", rr.EncodedImage.from_fields(draw_order=1.0))
    _images(columns, "patch/crafted", moments)
    strip = torch.cat([torch.nn.functional.pad(texels, (0, GAP, 0, 0)) for texels in moments], -1)
    columns.fixed("evolution", rr.EncodedImage(contents=_coded(strip, "jpeg"), media_type="image/jpeg"))
    side = moments.shape[-1]
    middles = [[place * (side + GAP) + side / 2, side + GAP] for place in range(len(steps))]
    first = next(iter(evolution.losses.values()), None)
    labels = [str(step) if first is None else f"{step}: {first[place]:.2f}" for place, step in enumerate(steps)]
    columns.fixed("evolution/steps", rr.Points2D(middles, labels=labels, radii=0.0, colors=[GREY], show_labels=True))
    losses = {name: values.double().nan_to_num().numpy() for name, values in evolution.losses.items()}
    if losses:
        bars = {name: (losses[name], LOSS_COLOURS[n % len(LOSS_COLOURS)]) for n, name in enumerate(losses)}
        highest = max((value for values in losses.values() for value in values), key=abs)
        _chart(columns, "losses", steps.astype(np.float64), bars, highest=highest)


def _chart(columns: Columns, path: str, x: Array, bars: Mapping[str, tuple[Array, Colour]], *, highest: float) -> None:
    """Send a bar chart with groups of bars at each x, and an overlay that marks the current row of the viewer."""
    gap = float(np.abs(np.diff(x)).min(initial=np.inf)) if len(x) > 1 else 1.0
    width = 0.8 * gap / len(bars)
    # rerun's abscissa is the left edge of a bar.
    for place, (name, (values, colour)) in enumerate(bars.items()):
        left = x - 0.4 * gap + place * width
        columns.fixed(f"{path}/{name}", rr.BarChart(values, abscissa=left, widths=np.full(len(x), width), color=colour))
    now = rr.BarChart.columns(
        values=_tensors(np.full(len(x), ROOM * highest)),
        abscissa=_tensors(x - 0.5 * gap),
        widths=np.full(len(x), gap),
        color=np.array([(255, 255, 255, FAINT)] * len(x), np.uint8),
    )
    columns.send(f"{path}/now", now)


def _tensors(values: Array) -> pa.Array:
    """A column of tensors with one value each."""
    return pa.concat_arrays([rr.components.TensorDataBatch(value[None]).as_arrow_array() for value in values])


def _images(columns: Columns, path: str, pictures: Iterable[Tensor]) -> None:
    """Send one image [3, H, W] per row."""
    blobs = [_coded(picture, "jpeg") for picture in pictures]
    columns.send(path, rr.EncodedImage.columns(blob=blobs, media_type=["image/jpeg"] * len(blobs)))


def _coded(picture: Tensor, form: Literal["jpeg", "png"]) -> bytes:
    """Encode an image [3, H, W] sRGB in [0, 1] as JPEG or PNG."""
    pixels = (255 * picture).round().to(torch.uint8).permute(1, 2, 0).numpy()
    quality = [cv2.IMWRITE_JPEG_QUALITY, QUALITY] if form == "jpeg" else []
    done, blob = cv2.imencode(f".{form}", pixels[..., ::-1], quality)
    assert done
    return bytes(blob)
