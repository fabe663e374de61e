"""An appearing attack: a plate in which a detector sees a stop sign where there is none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from torch import Tensor

from cavbench.attacks.detection.eot import seen_at
from cavbench.attacks.detection.shaped import ShapedEOT
from cavbench.attacks.detection.views import Views
from cavbench.detection import PatchOracle, Predictions
from cavbench.detection.mount import Shape

if TYPE_CHECKING:
    from cavbench.attacks.detection.transformations import Transformations


@dataclass(frozen=True, kw_only=True)
class Appear(ShapedEOT):
    """A plate that is taken for a stop sign (appearing attack, Zhao et al. 2019, arXiv 1812.10217).

    `eot` the other way round, under `threat.shape=plate`: the highest score of a stop sign on the plate is maximised.

    Args:
        loss: what is maximised: the mean of the score, or of its log-odds (default log_odds).
        window: side in pixels of the square window around the plate (default 160).

    The other parameters are those of `eot`.

    Queries: restarts * steps * batch images.

    Example:
        >>> from cavbench.attacks.detection.appear import Appear
        >>> of_pale_colours = Appear(nps=0.1)
    """

    shape: ClassVar[Shape] = "plate"
    towards: ClassVar[float] = -1.0

    def _scores(
        self, oracle: PatchOracle, views: Views, transform: Transformations, predictions: Predictions
    ) -> Tensor:
        """[N] the highest score of a stop sign whose middle is on the plate."""
        return seen_at(transform.carried(views.reach), predictions, oracle.label)
