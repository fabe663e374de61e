"""Procedural textures from a seed: linear reflectances [H, W, 3] in [0, 1]."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Rng = np.random.Generator
Texture = NDArray[np.float32]
Colour = tuple[float, float, float]


def noise(side: int, rng: Rng, octaves: int = 6, cells: int = 4, persistence: float = 0.55) -> NDArray[np.float32]:
    """Value noise [side, side] in [0, 1]: octaves of smoothed random grids, with weights falling by `persistence`."""
    total, weight = np.zeros((side, side), np.float32), 1.0
    for octave in range(octaves):
        grid = min(cells * 2**octave, side)
        layer = rng.random((grid, grid)).astype(np.float32)
        # The border is repeated so that the texture can be tiled.
        layer = np.pad(layer, 2, mode="wrap")
        wide = round(side * (grid + 4) / grid)
        edge = round(2 * side / grid)
        total += weight * cv2.resize(layer, (wide, wide), interpolation=cv2.INTER_CUBIC)[edge:, edge:][:side, :side]
        weight *= persistence
    low, high = total.min(), total.max()
    return (total - low) / (high - low)


def between(share: NDArray[np.floating], low: Colour, high: Colour) -> Texture:
    """Colours from `low` where `share` is 0 to `high` where it is 1."""
    return (np.asarray(low) + share[..., None] * (np.asarray(high) - np.asarray(low))).astype(np.float32)


def asphalt(rng: Rng, side: int = 2048) -> Texture:
    """16 m of worn asphalt: stones, stains, tyre tracks and a few sealed cracks."""
    stones = cv2.GaussianBlur(rng.normal(size=(side, side)).astype(np.float32), (0, 0), 0.9) * 1.5
    share = 0.32 + 0.3 * (noise(side, rng, 5, 6) - 0.5) + 0.13 * stones
    surface = between(np.clip(share, 0, 1), (0.045, 0.045, 0.047), (0.2, 0.195, 0.19))
    for _ in range(9):
        path = np.cumsum(np.concatenate([rng.integers(0, side, (1, 2)), rng.normal(0, 13, (70, 2))]), 0)
        cv2.polylines(surface, [path.astype(np.int32)], False, (0.025,) * 3, int(rng.integers(1, 4)), cv2.LINE_AA)
    for _ in range(5):
        x, y = rng.integers(0, side - 300, 2)
        w, h = rng.integers(90, 280, 2)
        surface[y : y + h, x : x + w] *= rng.uniform(0.65, 0.85)
    return surface


def grass(rng: Rng, side: int = 1024) -> Texture:
    """5 m of mown grass."""
    surface = between(noise(side, rng, 7, 4, 0.7), (0.03, 0.055, 0.015), (0.13, 0.19, 0.05))
    starts = rng.integers(0, side, (24_000, 2))
    ends = starts + rng.normal(0, 5, (24_000, 2)).astype(int)
    for start, end, light in zip(starts.tolist(), ends.tolist(), rng.uniform(0.35, 1.2, 24_000).tolist(), strict=True):
        cv2.line(surface, start, end, (0.10 * light, 0.16 * light, 0.04 * light), 1, cv2.LINE_AA)
    return surface


def concrete(rng: Rng, side: int = 512) -> Texture:
    """One slab with its joint."""
    surface = between(noise(side, rng, 7, 4, 0.7), (0.22, 0.21, 0.195), (0.42, 0.41, 0.38))
    surface[:4] *= 0.4
    surface[:, :4] *= 0.4
    return surface


def leaves(rng: Rng, base: Colour) -> Texture:
    """A palette of colours for leaf quads."""
    return (np.asarray(base) * rng.uniform(0.6, 1.5, (16, 16, 1)) + rng.uniform(0, 0.012, (16, 16, 3))).astype(
        np.float32
    )


def facade(rng: Rng, kind: str, side: int = 1024, storeys: int = 4, columns: int = 5) -> Texture:
    """A house front of `brick` or `plaster` with `storeys` by `columns` windows; the first row is the top."""
    if kind == "brick":
        surface = between(noise(side, rng, 6, 6), (0.2, 0.075, 0.05), (0.34, 0.15, 0.1))
        _bricks(surface, rng)
    else:
        tint = rng.uniform(0.8, 1.1, 3)
        low, high = tuple(np.array([0.4, 0.36, 0.28]) * tint), tuple(np.array([0.56, 0.51, 0.42]) * tint)
        surface = between(noise(side, rng, 6, 4), low, high)
    height, width = side // storeys, side // columns
    for storey in range(storeys):
        for column in range(columns):
            _window(surface, rng, column * width, storey * height, width, height)
    return surface


def _bricks(surface: Texture, rng: Rng, height: int = 10, width: int = 30) -> None:
    side = len(surface)
    mortar = (0.36, 0.34, 0.31)
    for row, y in enumerate(range(0, side, height)):
        for x in range(-width, side, width):
            left = x + (width // 2) * (row % 2)
            surface[y : y + height, max(0, left) : max(0, left + width)] *= rng.uniform(0.75, 1.2)
            surface[y : y + height, max(0, left) : max(0, left + 2)] = mortar
        surface[y : y + 2] = mortar


def _window(surface: Texture, rng: Rng, x: int, y: int, width: int, height: int) -> None:
    top, bottom = y + int(0.2 * height), y + int(0.78 * height)
    left, right = x + int(0.25 * width), x + int(0.75 * width)
    cv2.rectangle(surface, (left - 8, top - 8), (right + 8, bottom + 14), (0.58, 0.56, 0.52), -1)
    sheen = np.linspace(0, 1, bottom - top)[:, None] * np.ones((1, right - left))
    pane = between(sheen, (0.10, 0.13, 0.17), (0.03, 0.035, 0.04)) * rng.uniform(0.6, 1.3)
    surface[top:bottom, left:right] = pane
    if rng.random() < 0.5:
        drawn = top + int((bottom - top) * rng.uniform(0.2, 0.7))
        surface[top:drawn, left:right] = np.array((0.5, 0.47, 0.42)) * rng.uniform(0.6, 1)
    frame = (0.48, 0.48, 0.46)
    cv2.rectangle(surface, (left, top), (right, bottom), frame, 5)
    cv2.line(surface, ((left + right) // 2, top), ((left + right) // 2, bottom), frame, 5)
