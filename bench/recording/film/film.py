"""A film: pictures of an episode at equal intervals."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
"""RGB, [height, width, 3]."""
GAP = 14
"""Pixels between films that are shown together."""
PAPER = (255, 255, 255)


class Film(ABC):
    """The pictures of one episode.

    Args:
        fps: pictures per second, in the time of the episode.
        photographs: whether the pictures are photographs; WebP files of photographs are lossy, and GIFs have more colours.
    """

    fps: float
    photographs: bool = False

    @abstractmethod
    def __len__(self) -> int:
        """Number of steps of the episode."""

    @abstractmethod
    def pictures(self, steps: int) -> Iterator[Picture]:
        """One picture for each of `steps` steps; after its end the last one is held."""


class _Stacked(Film):
    def __init__(self, films: Sequence[Film]) -> None:
        self.films, self.fps = films, films[0].fps
        self.photographs = any(film.photographs for film in films)

    def __len__(self) -> int:
        return max(map(len, self.films))

    def pictures(self, steps: int) -> Iterator[Picture]:
        for several in zip(*(film.pictures(steps) for film in self.films), strict=True):
            width = max(picture.shape[1] for picture in several)
            parts = []
            for picture in several:
                wide = np.full((picture.shape[0] + GAP, width, 3), PAPER, np.uint8)
                wide[: picture.shape[0], : picture.shape[1]] = picture
                parts.append(wide)
            yield np.concatenate(parts)[:-GAP]


def stacked(films: Sequence[Film]) -> Film:
    """Films one below the other, in step; one film is itself."""
    return films[0] if len(films) == 1 else _Stacked(films)
