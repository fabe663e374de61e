"""Measures what compiled updates save in the training of drivers:

    python benchmarks/training_speed.py [--victims dqn ppo sac] [--rounds 3] [--decisions 64]
    python benchmarks/training_speed.py [--victims dqn ppo sac] --curves 10

Prints the CPU milliseconds of a decision on all roads, driving and learning apart, in both phases of the training, with torch's
updates and with compiled ones; and the CPU minutes of a whole training without its checkpoints. Both are measured alternately
in one process and one thread; the medians of the rounds are printed. Torch's updates are those of before, and still those of
adversarial training.

With `--curves` it trains with that many seeds in both ways, shortly and on few roads, and prints the scores of the checkpoints.
"""

from __future__ import annotations

import argparse
import logging
import statistics
import time
from collections.abc import Sequence
from unittest.mock import patch

import torch

from cavbench.core.pair import choose
from cavbench.driving import TrainingHooks
from cavbench.driving.victims.learner import CHUNK, Learner
from cavbench.driving.victims.practice import Practice, roads
from cavbench.driving.victims.training import LearningDriver
from cavbench.envs.highway.world import HighwayWorld
from cavbench.run.process import settle

WAYS = {"torch": True, "compiled": False}
SHORT = {"decisions": 2000, "copies": 4, "batch": 256, "checkpoints": 2}
ROLLOUTS = {"batch": 128, "fine_rollout": 32, "fine_batch": 256, "settling": 1}
"""A short training has as many rollouts as it can learn from."""


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--victims", nargs="+", default=["dqn"])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--decisions", type=int, default=64, help="decisions of a round")
    parser.add_argument("--curves", type=int, default=0, help="seeds of short trainings")
    arguments = parser.parse_args()
    settle()
    logging.disable(logging.INFO)
    for name in arguments.victims:
        if arguments.curves:
            _curves(name, arguments.curves)
        else:
            _speed(name, arguments.rounds, arguments.decisions)


def _speed(name: str, rounds: int, decisions: int) -> None:
    victim = choose("victim", name).component
    print("| victim, phase | driving | learning: torch, ms | compiled, ms | whole decision, torch / compiled |")
    print("|---|---|---|---|---|")
    minutes = dict.fromkeys(WAYS, 0.0)
    for number, phase in enumerate(victim.phases(TrainingHooks())):
        practices = {way: _practice(victim, number, torchs) for way, torchs in WAYS.items()}
        # The first round compiles. A round has whole rollouts, if it learns from those.
        length = max([decisions, *(getattr(each.learner, "rollout", 0) for each in practices.values())])
        found = [{way: _round(each, length) for way, each in practices.items()} for _ in range(rounds + 1)][1:]
        drive, learn = ({way: statistics.median(one[way][at] for one in found) for way in WAYS} for at in (0, 1))
        ratio = statistics.median(sum(one["torch"]) / sum(one["compiled"]) for one in found)
        for way in WAYS:
            minutes[way] += (drive[way] + learn[way]) * phase.decisions / 6e4
        print(
            f"| {name}, {number + 1} | {drive['torch']:.2f}, {drive['compiled']:.2f} | {learn['torch']:.2f} | "
            f"{learn['compiled']:.2f} | {ratio:.2f} x |",
            flush=True,
        )
    whole = minutes["torch"] / minutes["compiled"]
    print(
        f"\n{name}: {minutes['torch']:.1f} CPU minutes with torch, {minutes['compiled']:.1f} compiled, {whole:.2f} x\n"
    )


def _practice(victim: LearningDriver, number: int, torchs: bool) -> Practice:
    """A phase of the training with enough experience to learn from."""
    world, hooks = HighwayWorld(), TrainingHooks()
    torch.manual_seed(0)
    phase = victim.phases(hooks)[number]
    env = world.make(roads(world, victim.copies), action_type=victim.action_type, action_repeat=phase.repeat)
    env.set_seed(0)
    with patch.object(TrainingHooks, "learns_otherwise", torchs):
        learner: Learner = victim.learner(env, hooks)
    learner.enter(phase)
    practice = Practice(env, learner, phase, crash_penalty=victim.crash_penalty)
    practice.drive(5 * CHUNK, 0.5)
    return practice


def _round(practice: Practice, decisions: int) -> tuple[float, float]:
    """CPU milliseconds a decision, of driving and of learning."""
    drive = learn = 0.0
    for _ in range(decisions // CHUNK):
        started = time.process_time()
        practice.drive(CHUNK, 0.5)
        driven = time.process_time()
        practice.learner.learn(1e-4, 0.5)
        drive, learn = drive + driven - started, learn + time.process_time() - driven
    return 1e3 * drive / decisions, 1e3 * learn / decisions


def _curves(name: str, seeds: int) -> None:
    short = ROLLOUTS if name == "ppo" else {"memory": 100_000}
    victim = choose("victim", name, **SHORT | short).component
    print(
        f"| {name} | share of the training | mean over {seeds} seeds | standard deviation | of each seed |\n|---|---|---|---|---|"
    )
    for way, torchs in WAYS.items():
        curves = [_curve(victim, seed, torchs) for seed in range(seeds)]
        for scores in zip(*curves, strict=True):
            values = [score for _, score in scores]
            spread = statistics.stdev(values) if seeds > 1 else 0.0
            each = ", ".join(f"{value:.2f}" for value in sorted(values))
            print(f"| {way} | {scores[0][0]:.2f} | {statistics.mean(values):.3f} | {spread:.3f} | {each} |", flush=True)


def _curve(victim: LearningDriver, seed: int, torchs: bool) -> Sequence[tuple[float, float]]:
    with patch.object(TrainingHooks, "learns_otherwise", torchs):
        card = victim.train(HighwayWorld(), seed=seed, progress=lambda share, text: None).card
    history = card["selection_history"]
    assert isinstance(history, list)
    return history


if __name__ == "__main__":
    main()
