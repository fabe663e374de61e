"""A lie that fits how cars move: all relative distances and speeds along the road in another scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.driving import DrivingAttack, Oracle


@dataclass(frozen=True, kw_only=True)
class Scaling(DrivingAttack):
    """Shows the distance and the relative speed of every other car along the road, scaled by one factor for the whole episode.

    A motion stays a possible motion if it is scaled: the shown position changes by the integral of the shown velocity. So a
    monitor that checks kinematics has nothing to see. This is a false data injection that stays unseen, as Mo and Sinopoli
    2010 show for linear systems. It makes no queries, and does not change the ego's row. The factor is 1 - budget or
    1 + budget. Distance: the perturbation set of the threat model, of the norm `relative`; a wider one is not used.

    Args:
        outlook: `farther`: everything seems farther away. `nearer`: everything seems nearer.

    Shapes: observation [B, V, F] in, the same out.
    """

    access: ClassVar[Access] = "oblivious"
    joint: ClassVar[bool] = True
    needs: ClassVar[tuple[str, ...]] = ("x", "vx")

    outlook: Literal["farther", "nearer"] = "farther"

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        features, shown = oracle.features, observation.clone()
        share = oracle.threat.budget * (1 if self.outlook == "farther" else -1)
        physical = features.physical(observation)
        for name in self.needs:
            place = features.names.index(name)
            change = share * physical[:, 1:, place] / features.half_range()[place]
            shown[:, 1:, 1 + place] += change * observation[:, 1:, 0]
        return oracle.project(shown)
