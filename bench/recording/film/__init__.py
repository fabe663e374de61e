"""Films of episodes as GIF, WebP or MP4 files, for places without a display or the rerun viewer."""

from bench.recording.film.film import Film, stacked
from bench.recording.film.writing import KINDS, save

__all__ = ["KINDS", "Film", "save", "stacked"]
