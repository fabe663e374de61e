"""The curves of a recording: decisions, scores, perturbation and its budget, queries, speed, TTC, progress and reward."""

from __future__ import annotations

import colorsys
from itertools import cycle

import numpy as np

from cavbench.driving.recording.episode import Episode
from cavbench.driving.recording.scene import CRASHED
from cavbench.recording.colours import EGO, GREY, MEASURED, SHOWN, Colour
from cavbench.recording.columns import Columns

ACTION_COLOURS: tuple[Colour, ...] = (
    (187, 154, 247),
    (120, 124, 134),
    (125, 207, 255),
    (158, 206, 106),
    (247, 118, 142),
)
FEATURE_COLOURS: dict[str, Colour] = {
    "x": (255, 158, 74),
    "y": (125, 207, 255),
    "vx": (255, 158, 74),
    "vy": (125, 207, 255),
}


def group(unit: str) -> str:
    """The entity path for perturbations with a unit; `m/s` cannot be part of a path."""
    return f"perturbation/{'velocity' if '/' in unit else 'position'}"


def log(episode: Episode, columns: Columns) -> None:
    """Send every curve of an episode."""
    _decisions(episode, columns)
    _scores(episode, columns)
    if episode.attacked:
        _perturbation(episode, columns)
        columns.curve("queries/spent", episode.steps["queries"], "queries per step", SHOWN)
    columns.curve("speed/ego", episode.steps["speed"], "speed (m/s)", EGO)
    columns.curve("ttc/ahead", episode.steps["ttc"], "time to collision (s)", CRASHED)
    columns.curve("worth/progress", episode.steps["progress"], "progress (0 to 1)", EGO)
    columns.curve("worth/reward", episode.steps["reward"], "reward (0 to 1)", GREY)


def _decisions(episode: Episode, columns: Columns) -> None:
    clean, taken = episode.choices
    if not episode.discrete:
        return
    if episode.attacked:
        columns.states("decision/clean", clean, episode.facts.actions, ACTION_COLOURS)
    columns.states("decision/taken", taken, episode.facts.actions, ACTION_COLOURS)


def _scores(episode: Episode, columns: Columns) -> None:
    names = episode.facts.actions if episode.discrete else episode.facts.controls
    colours = ACTION_COLOURS if episode.discrete else (EGO, MEASURED)
    for place, (name, colour) in enumerate(zip(names, cycle(colours), strict=False)):
        columns.curve(f"scores/shown/{name}", episode.steps["scores"][:, place], name, colour)
        if episode.attacked:
            values = episode.steps["clean_scores"][:, place]
            columns.curve(f"scores/measured/{name}", values, name, colour)


def _perturbation(episode: Episode, columns: Columns) -> None:
    for feature, unit in zip(episode.features.names, episode.features.units, strict=True):
        colour = FEATURE_COLOURS.get(feature, GREY)
        columns.curve(f"{group(unit)}/{feature}", episode.moved(feature), f"{feature} perturbation ({unit})", colour)
        budget = episode.budget[feature]
        columns.curve(f"{group(unit)}/{feature}_budget", budget, f"{feature} budget", _faint(colour), 1.0)


def _faint(colour: Colour) -> Colour:
    """The same hue, darker and paler."""
    hue, light, strength = colorsys.rgb_to_hls(*(part / 255 for part in colour))
    red, green, blue = (
        int(np.clip(255 * part, 0, 255)) for part in colorsys.hls_to_rgb(hue, light * 0.6, strength * 0.5)
    )
    return red, green, blue
