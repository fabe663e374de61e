"""Sends whole columns to a rerun recording: one block per entity, on given timelines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cavbench.recording.colours import Colour


class Columns:
    """Sends columns of one length.

    Args:
        stream: the recording.
        timelines: position of each row by timeline name: integers, or seconds.
    """

    def __init__(self, stream: rr.RecordingStream, timelines: Mapping[str, NDArray[np.generic]]) -> None:
        self.stream = stream
        kinds = {name: "sequence" if values.dtype.kind == "i" else "duration" for name, values in timelines.items()}
        self.index = [rr.TimeColumn(name, **{kinds[name]: values}) for name, values in timelines.items()]

    def send(self, path: str, columns: Iterable[Any]) -> None:
        """Send one value, or one list of instances, per row."""
        rr.send_columns(path, self.index, columns, recording=self.stream)

    def fixed(self, path: str, what: rr.AsComponents) -> None:
        """Send one value for the whole recording."""
        self.stream.log(path, what, static=True)

    def note(self, path: str, markdown: str) -> None:
        """Send a page of Markdown."""
        self.fixed(path, rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def curve(self, path: str, values: NDArray[np.generic], name: str, colour: Colour, width: float = 1.5) -> None:
        """Send a curve [T] with its name in the legend; it has gaps where values are not finite."""
        finite = np.where(np.isfinite(values), values, np.nan).astype(np.float64)
        self.fixed(path, rr.SeriesLines(colors=[colour], widths=[width], names=[name]))
        self.send(path, rr.Scalars.columns(scalars=finite))

    def states(self, path: str, values: NDArray[np.generic], names: Iterable[str], colours: Iterable[Colour]) -> None:
        """Send a band of states: `values` [T] are indices into `names`."""
        labels = list(names)
        self.fixed(path, rr.StateConfiguration(values=labels, labels=labels, colors=list(colours)))
        self.send(path, rr.StateChange.columns(state=[labels[int(value)] for value in values]))
