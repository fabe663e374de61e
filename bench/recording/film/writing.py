"""Writes films to files: GIF and WebP with Pillow, MP4 (VP9, which browsers play) with OpenCV."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from cavbench.errors import UserError
from cavbench.recording.film.film import Film, Picture

COLOURS, COLOURS_OF_PHOTOGRAPHS = 64, 256
"""Colours of a GIF."""
QUALITY = 55
"""Of a WebP of photographs, from 0 to 100."""
GIF_FPS = 10.0
"""A GIF shows at most so many pictures a second, in real time: its size grows with their number."""
HELD_S = 1.5
"""Seconds for which the last picture stays."""


def save(film: Film, path: Path, *, seconds: tuple[float, float] | None = None) -> None:
    """Write a film; the ending of the file's name says how.

    Args:
        film: the film.
        path: the file, `.gif`, `.webp` or `.mp4`.
        seconds: the part to show, from and to; None for all.

    Raises:
        UserError: if the ending is another one, the part is empty, or the file cannot be written.
    """
    writer = KINDS.get(path.suffix.lower())
    if writer is None:
        raise UserError(f"{path} is not {', '.join(KINDS)}: films are written to these")
    first, last = (0, len(film)) if seconds is None else (round(part * film.fps) for part in seconds)
    if not 0 <= first < last:
        raise UserError(f"seconds must be FROM:TO with FROM below TO, got {seconds}")
    pictures = itertools.islice(film.pictures(max(len(film), last)), first, min(last, len(film)))
    draft = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        writer(pictures, film, draft)
        os.replace(draft, path)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        draft.unlink(missing_ok=True)


def _animation(pictures: Iterator[Picture], film: Film, path: Path) -> None:
    """A GIF or WebP that repeats, in real time with every k-th picture."""
    every = max(1, int(np.ceil(film.fps / GIF_FPS)))
    shown = list(pictures)
    # The last picture is kept, because it shows how the episode ended.
    kept = [Image.fromarray(picture) for picture in shown[::-1][::every][::-1]]
    # Durations of a GIF are in hundredths of a second.
    durations = [round(100 * every / film.fps) * 10] * (len(kept) - 1) + [round(1000 * HELD_S)]
    if path.suffix.lower() == ".webp":
        how = {"quality": QUALITY} if film.photographs else {"lossless": True}
        kept[0].save(path, save_all=True, append_images=kept[1:], duration=durations, loop=0, method=2, **how)
        return
    # One palette for all pictures: of the first, the middle and the last, which have all colours between them.
    sample = np.concatenate([np.asarray(kept[place]) for place in (0, len(kept) // 2, -1)])
    colours = COLOURS_OF_PHOTOGRAPHS if film.photographs else COLOURS
    palette = Image.fromarray(sample).quantize(colours, Image.Quantize.MEDIANCUT)
    flat = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in kept]
    flat[0].save(path, save_all=True, append_images=flat[1:], duration=durations, loop=0, optimize=True)


def _video(pictures: Iterator[Picture], film: Film, path: Path) -> None:
    """An MP4 with VP9, which takes a tenth of a second a picture: the builds of OpenCV on the package index have no H.264."""
    writer = None
    try:
        for picture in pictures:
            even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]
            if writer is None:
                size = (even.shape[1], even.shape[0])
                writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"vp09"), film.fps, size)
                if not writer.isOpened():
                    raise UserError("this build of OpenCV writes no VP9 video; save a .gif or .webp instead")
            writer.write(cv2.cvtColor(even, cv2.COLOR_RGB2BGR))
        for _ in range(round(HELD_S * film.fps)):
            assert writer is not None
            writer.write(cv2.cvtColor(even, cv2.COLOR_RGB2BGR))
    finally:
        if writer is not None:
            writer.release()


KINDS: dict[str, Callable[[Iterator[Picture], Film, Path], None]] = {
    ".gif": _animation,
    ".webp": _animation,
    ".mp4": _video,
}
"""The kinds of files, by the ending of their names."""
