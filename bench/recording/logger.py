"""Training curves in a rerun recording, as a TorchRL logger."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import torch
from torch import Tensor
from torchrl.record.loggers import Logger


class RerunLogger(Logger):
    """Writes curves, hyper-parameters and histograms to `log_dir/exp_name.rrd`, over the timeline `step`.

    Args:
        exp_name: name of the recording and of its file.
        log_dir: folder, made if it is not there.
    """

    def __init__(self, exp_name: str, log_dir: str | Path = ".") -> None:
        self.path = Path(log_dir) / f"{exp_name}.rrd"
        super().__init__(exp_name=exp_name, log_dir=str(log_dir))

    def _create_experiment(self) -> rr.RecordingStream:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        stream = rr.RecordingStream("cavbench-training", recording_id=self.exp_name)
        stream.save(self.path)
        stream.send_recording_name(self.exp_name)
        return stream

    def _at(self, step: int | None) -> None:
        if step is not None:
            self.experiment.set_time("step", sequence=step)

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        """A point of a curve."""
        self._at(step)
        self.experiment.log(name, rr.Scalars(float(value)))

    def log_video(self, name: str, video: Tensor, step: int | None = None, **kwargs: Any) -> None:
        """The frames of a video, uint8 [..., T, 3, H, W], on the timeline `frame`."""
        self._at(step)
        for number, frame in enumerate(video.reshape(-1, *video.shape[-3:])):
            self.experiment.set_time("frame", sequence=number)
            self.experiment.log(name, rr.Image(frame.permute(1, 2, 0).to(torch.uint8).cpu().numpy()))

    def log_hparams(self, cfg: Mapping[str, Any] | Any) -> None:
        """Hyper-parameters, as a page of text."""
        items = cfg.items() if isinstance(cfg, Mapping) else vars(cfg).items()
        text = "\n".join(f"- **{name}** {value}" for name, value in items)
        self.experiment.log("hparams", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)

    def log_histogram(self, name: str, data: Tensor | Sequence[float], **kwargs: Any) -> None:
        """A histogram as bars; keyword arguments: `step`, `bins` (default 32)."""
        self._at(kwargs.get("step"))
        counts, edges = np.histogram(torch.as_tensor(data).detach().cpu().numpy(), bins=kwargs.get("bins", 32))
        self.experiment.log(name, rr.BarChart(counts, abscissa=(edges[:-1] + edges[1:]) / 2))

    def __repr__(self) -> str:
        return f"{type(self).__name__}(exp_name={self.exp_name!r}, path={str(self.path)!r})"

    def flush(self) -> None:
        """Write what was logged so far."""
        self.experiment.flush()

    def shutdown(self) -> None:
        """Finish the file."""
        self.experiment.flush()
        self.experiment.disconnect()
