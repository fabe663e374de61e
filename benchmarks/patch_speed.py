"""Measures the time of crafting a patch, compared with the detector's passes alone, and of scoring a patch:

    python benchmarks/patch_speed.py [--victim yolov5] [--bank FOLDER] [--rounds 3] [--steps 4]

Alternates steps of `eot` with as many forward and backward passes of the detector alone, in one process and one thread: at its
defaults, at its defaults in windows of 160 pixels, and as the suite has it in such windows. Likewise rendering the frames of an
approach with rendering and detecting. Prints medians over the rounds, because the machine may be busy; "times" is the median of
the ratios of the rounds. The last figures are those of the same step with the detector in bfloat16.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from cavbench.attacks.detection.eot import EOT
from cavbench.attacks.detection.suites import STANDARD_DETECTION_3
from cavbench.detection import STOP_SIGN, Detector, PatchThreat, Scenes
from cavbench.detection.access import PatchEnforcer
from cavbench.detection.approach import look
from cavbench.detection.victims.yolov3_tiny import YOLOv3Tiny
from cavbench.detection.victims.yolov5 import YOLOv5
from cavbench.envs.camera.axes import APPROACH_V1
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import in_one_line
from cavbench.run.process import settle

GRID, THREAT, WORKERS = APPROACH_V1, PatchThreat(), 2
SMALL = 160
"""Side of the windows of most members of the suite, in pixels."""
VICTIMS: Mapping[str, type[YOLOv3Tiny] | type[YOLOv5]] = {"yolov3_tiny": YOLOv3Tiny, "yolov5": YOLOv5}
CLOCKS = ("processor", "wall")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--victim", choices=VICTIMS, default="yolov3_tiny")
    parser.add_argument("--bank", default="", help="folder of rendered frames (default: the shipped ones)")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=4, help="steps of the attack per round")
    arguments = parser.parse_args()
    settle()
    torch.manual_seed(0)
    world = StopSignApproach(bank=arguments.bank)
    detector, scenes = VICTIMS[arguments.victim]().load(0, world.facts), world.training_scenes()
    print(f"{arguments.victim}, one thread")
    decode(scenes)
    for name, attack in variants():
        craft(name, replace(attack, steps=arguments.steps, restarts=1), detector, scenes, arguments.rounds)
    score(detector, world, arguments.rounds)


def decode(scenes: Scenes) -> None:
    """Print the time of decoding all frames, which a crafting pays once."""

    def first_rendering() -> None:
        for frame in torch.arange(len(scenes)).split(1):
            scenes.windows(frame, None, THREAT.budget, torch.zeros(1, 2, dtype=torch.int64), (SMALL, SMALL))

    spent = zip(CLOCKS, seconds(first_rendering), strict=True)
    print(f"decoding {len(scenes)} frames, once: " + ", ".join(f"{name} {each:.1f} s" for name, each in spent))


def variants() -> Iterator[tuple[str, EOT]]:
    """The attacks that are measured, with their names."""
    yield "defaults", EOT()
    yield f"defaults, windows of {SMALL}", EOT(window=SMALL)
    for member in STANDARD_DETECTION_3.members:
        if member.attack == "eot" and member.params.get("window") == SMALL:
            attack = EOT(**member.params)
            turned = "turned and scaled" if attack.rotation else "shifts only"
            yield f"suite, {turned}, batches of {attack.batch}", attack


def craft(name: str, attack: EOT, detector: Detector, scenes: Scenes, rounds: int) -> None:
    """Print the time of a step of an attack, once the frames are decoded."""
    generator, steps = torch.Generator().manual_seed(0), attack.steps
    pictures = torch.rand(attack.batch, 3, attack.window, attack.window, generator=generator)
    label = detector.index(STOP_SIGN)

    def passes() -> None:
        for _ in range(steps):
            shown = pictures.clone().requires_grad_()
            detector(shown).scores_of(label).amax(-1).mean().backward()

    def step(attack: EOT) -> None:
        attack.craft(PatchEnforcer(detector, THREAT, attack.access, generator).oracle, scenes, lambda share, text: None)

    in_half = replace(attack, precision="bfloat16")
    alone, whole, half = turns(passes, partial(step, attack), partial(step, in_half), rounds=rounds) / steps
    print(f"a step of eot: {name}")
    for clock, said in enumerate(CLOCKS):
        medians, times = np.median((alone[clock], whole[clock]), 1) * 1000, np.median(whole[clock] / alone[clock])
        print(
            f"  {said:<9}  detector {medians[0]:5.0f} ms   step {medians[1]:5.0f} ms   {times:.2f} times (goal: 1.25)   "
            f"in bfloat16 {np.median(half[clock]) * 1000:5.0f} ms   {np.median(whole[clock] / half[clock]):.2f} times as fast"
        )


def score(detector: Detector, world: StopSignApproach, rounds: int) -> None:
    """Print the time of one frame of an approach, and of the standard grid."""
    texels = torch.rand(3, EOT.texels, EOT.texels)

    def scenes() -> Scenes:
        return world.approaches(GRID.cells()[0], GRID.seeds()[:1])[0].scenes

    frames = torch.arange(len(scenes()))
    with torch.no_grad():
        rendering, looking = turns(
            lambda: scenes().render(frames, texels.unsqueeze(0), THREAT.budget),
            lambda: look(detector, scenes(), texels, THREAT.budget),
            rounds=rounds,
        ) / len(frames)
    height, width = scenes().size
    total = len(GRID.cells()) * len(GRID.seeds()) * len(frames)
    print(f"scoring a patch: batch {len(frames)}, images of {width} x {height}")
    for clock, name in enumerate(CLOCKS):
        rendered, seen = np.median((rendering[clock], looking[clock]), 1)
        print(
            f"  {name:<9}  rendering {rendered * 1000:4.0f} ms   with the detector {seen * 1000:4.0f} ms a frame, "
            f"{1 / seen:.1f} frames a second"
        )
        whole = total * seen / WORKERS
        print(f"             {GRID.name}: {total} frames, {WORKERS} workers, {whole:.0f} s (goal: 180 s)")


def turns(*works: Callable[[], object], rounds: int) -> np.ndarray:
    """[works, 2, rounds] CPU and wall seconds of each work, alternating, after one round to warm up."""
    return np.array([[seconds(work) for work in works] for _ in range(rounds + 1)][1:]).transpose(1, 2, 0)


def seconds(work: Callable[[], object]) -> np.ndarray:
    """[2] CPU and wall seconds of a work."""
    start = np.array([time.process_time(), time.perf_counter()])
    work()
    return np.array([time.process_time(), time.perf_counter()]) - start


if __name__ == "__main__":
    with in_one_line():
        main()
