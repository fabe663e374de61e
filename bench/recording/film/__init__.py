"""Films of episodes as GIF, WebP or MP4 files, for places without a display or the rerun viewer."""

from cavbench.recording.film.film import Film, stacked
from cavbench.recording.film.writing import KINDS, save

__all__ = ["KINDS", "Film", "save", "stacked"]
