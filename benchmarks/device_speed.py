"""Compares `device=cuda` with the processor: a unit of driving under `zo`, and crafting a patch with `eot`.

    python benchmarks/device_speed.py [--episodes 30] [--steps 20] [--rounds 3]

Both run in turns in one process with one thread; the ratio is the median over the rounds. Prints the scores, too, because a GPU
rounds otherwise. Without a GPU it says so.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from cavbench.core.pair import Chosen, Pair, choose
from cavbench.core.track import Job
from cavbench.detection.crafting import prepare
from cavbench.detection.drive import drive as score
from cavbench.driving.drive import drive
from cavbench.errors import in_one_line
from cavbench.run.process import settle
from cavbench.scenarios import SeedBlock

DEVICES = ("cpu", "cuda")


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description="Compare device=cuda with the processor.")
    parser.add_argument("--episodes", type=int, default=30, help="episodes of the unit of driving")
    parser.add_argument("--steps", type=int, default=20, help="steps of eot")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        print("there is no GPU that torch can use: nothing was measured")
        return
    settle()
    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}")
    print("| work | processor, s | GPU, s | ratio | score on the processor | on the GPU |\n|---|---|---|---|---|---|")
    seeds = range(SeedBlock.TUNE, SeedBlock.TUNE + arguments.episodes)
    driving = _job(choose("attack", "zo"), "dqn", "advtrain", "highway", seeds)
    eot = choose("attack", "eot", steps=arguments.steps)
    detection = _job(eot, "yolov3_tiny", "advtrain_detection", "camera", range(1_000_000, 1_000_003))
    _compare("a unit of `zo`", driving, _driven, arguments.rounds)
    _compare(f"`eot`, {arguments.steps} steps, and scoring", detection, _crafted, arguments.rounds)


def _job(attack: Chosen, victim: str, defense: str, world: str, seeds: range) -> Job:
    found, place = choose("victim", victim), choose("world", world)
    pair = Pair(
        attack=attack, defense=choose("defense", defense), victim=found, world=place, threat=found.component.threat()
    )
    cell = place.component.axes.cell(lanes=3, density=1.0, weather="clear")
    return Job(pair=pair, training_seed=0, attack_seed=1, cell=cell, seeds=seeds)


def _driven(job: Job) -> float:
    return float(np.mean(drive(job, ()).columns["safe_progress"]))


def _crafted(job: Job) -> float:
    patch = prepare(job, "a benchmark", lambda share, text: None)
    return float(np.mean(score(job, patch, ()).columns["confidence_mean"]))


def _compare(what: str, job: Job, work: Callable[[Job], float], rounds: int) -> None:
    jobs = {device: replace(job, device=device) for device in DEVICES}
    # The first pass loads kernels and frames.
    scores = {device: work(own) for device, own in jobs.items()}
    seconds = [{device: _seconds(lambda own=own: work(own)) for device, own in jobs.items()} for _ in range(rounds)]
    cpu, gpu = (statistics.median(one[device] for one in seconds) for device in DEVICES)
    ratio = statistics.median(one["cuda"] / one["cpu"] for one in seconds)
    print(f"| {what} | {cpu:.2f} | {gpu:.2f} | {ratio:.2f} | {scores['cpu']:.3f} | {scores['cuda']:.3f} |", flush=True)


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


if __name__ == "__main__":
    with in_one_line():
        main()
