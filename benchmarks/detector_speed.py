"""Measures the time of a detector's forward and backward pass:

    python benchmarks/detector_speed.py [--side 640] [--rounds 5]

The weights are random; the time does not depend on them. The minimum over the rounds counts, because the machine may be busy.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch

from cavbench.detection import Detector
from cavbench.detection.victims.yolo import frozen
from cavbench.detection.victims.yolov3_tiny import YOLOv3TinyNetwork
from cavbench.detection.victims.yolov5 import YOLOv5Network
from cavbench.run.process import settle

STOP_SIGN = 11


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--side", type=int, default=640, help="side of the images in pixels")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    settle()
    torch.manual_seed(0)
    detectors = {"yolov3_tiny": YOLOv3TinyNetwork(), "yolov5n": YOLOv5Network("n"), "yolov5s": YOLOv5Network("s")}
    print(f"milliseconds for images of {arguments.side} x {arguments.side}, minimum of {arguments.rounds} rounds")
    print(f"{'':<12} {'threads':>8} {'images':>9} {'forward':>9} {'+backward':>9}")
    for name, network in detectors.items():
        detector = frozen(network)
        for threads in (1, 2):
            torch.set_num_threads(threads)
            for count in (1, 4):
                pictures = torch.rand(count, 3, arguments.side, arguments.side)
                works = (look(detector, pictures), differentiate(detector, pictures))
                forward, back = (least(work, arguments.rounds) for work in works)
                print(f"{name:<12} {threads:>8} {count:>9} {forward * 1000:>9.0f} {back * 1000:>9.0f}", flush=True)


def look(detector: Detector, pictures: torch.Tensor) -> Callable[[], object]:
    """A forward pass without a graph."""
    return torch.no_grad()(lambda: detector(pictures))


def differentiate(detector: Detector, pictures: torch.Tensor) -> Callable[[], object]:
    """A forward and backward pass: the gradient of each image's highest score of one class."""

    def work() -> None:
        shown = pictures.clone().requires_grad_()
        detector(shown).scores[..., STOP_SIGN].amax(-1).sum().backward()

    return work


def least(work: Callable[[], object], rounds: int) -> float:
    """Minimum time in seconds, after one round to warm up."""
    seconds = []
    for _ in range(rounds + 1):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return min(seconds[1:])


if __name__ == "__main__":
    main()
