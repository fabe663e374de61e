"""Compares a detector's passes with the peer, ONNX Runtime, on the same network and the same images:

    python benchmarks/detector_speed.py [--side 640] [--rounds 3] [--threads 1]

The peer answers only; the backward pass is what an attack with gradients pays in addition. The weights are random; the time does
not depend on them. Both run in turns, and the minimum over the rounds counts, because the machine may be busy. Needs
`pip install 'cavbench[onnx]'`.
"""

from __future__ import annotations

import argparse
import io
import logging
import time
from collections.abc import Callable

import torch

from cavbench.detection import Detector
from cavbench.detection.victims.yolo import frozen
from cavbench.detection.victims.yolov3_tiny import YOLOv3TinyNetwork
from cavbench.detection.victims.yolov5 import YOLOv5Network
from cavbench.errors import in_one_line
from cavbench.run.process import settle

STOP_SIGN = 11
IMAGES = (1, 4)


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description="Compare a detector's passes with ONNX Runtime.")
    parser.add_argument("--side", type=int, default=640, help="side of the images in pixels")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1, help="of both")
    arguments = parser.parse_args()
    settle()
    # The exporter says for each network that torchvision is not there.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    torch.manual_seed(0)
    torch.set_num_threads(arguments.threads)
    detectors = {"yolov3_tiny": YOLOv3TinyNetwork(), "yolov5n": YOLOv5Network("n"), "yolov5s": YOLOv5Network("s")}
    print(f"images of {arguments.side} x {arguments.side}, threads: {arguments.threads}, minimum of the rounds")
    print("| detector | images | ONNX Runtime, ms | forward, ms | ratio | and backward, ms | ratio |")
    print("|---|---|---|---|---|---|---|")
    for name, network in detectors.items():
        detector = frozen(network)
        for count in IMAGES:
            pictures = torch.rand(count, 3, arguments.side, arguments.side)
            works = (
                in_onnx_runtime(detector, pictures, arguments.threads),
                look(detector, pictures),
                differentiate(detector, pictures),
            )
            peer, forward, back = (1000 * least for least in minima(works, arguments.rounds))
            cells = (f"{peer:.0f}", f"{forward:.0f}", f"{forward / peer:.2f} x", f"{back:.0f}", f"{back / peer:.2f} x")
            print(f"| {name} | {count} | {' | '.join(cells)} |", flush=True)


def in_onnx_runtime(detector: Detector, pictures: torch.Tensor, threads: int) -> Callable[[], object]:
    """A forward pass of the same network in ONNX Runtime, with boxes and scores as its outputs."""
    import onnxruntime

    class Answers(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.detector = detector

        def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            predictions = self.detector(images)
            return predictions.boxes, predictions.scores

    written = io.BytesIO()
    program = torch.onnx.export(Answers().eval(), (pictures,), external_data=False, verbose=False)
    program.save(written)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(written.getvalue(), options, providers=["CPUExecutionProvider"])
    shown = {session.get_inputs()[0].name: pictures.numpy()}
    return lambda: session.run(None, shown)


def look(detector: Detector, pictures: torch.Tensor) -> Callable[[], object]:
    """A forward pass without a graph."""
    return torch.no_grad()(lambda: detector(pictures))


def differentiate(detector: Detector, pictures: torch.Tensor) -> Callable[[], object]:
    """A forward and backward pass: the gradient of each image's highest score of one class."""

    def work() -> None:
        shown = pictures.clone().requires_grad_()
        detector(shown).scores[..., STOP_SIGN].amax(-1).sum().backward()

    return work


def minima(works: tuple[Callable[[], object], ...], rounds: int) -> list[float]:
    """Minimum time in seconds of each work, carried out in turns, after one round to warm up."""
    return [
        min(times) for times in zip(*[[seconds(work) for work in works] for _ in range(rounds + 1)][1:], strict=True)
    ]


def seconds(work: Callable[[], object]) -> float:
    """Wall time."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


if __name__ == "__main__":
    with in_one_line():
        main()
