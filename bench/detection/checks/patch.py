"""Rules for attacks that craft a patch."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from cavbench.checks.check import BrokenRuleError, Check, NotApplicableError, Suite, one_line, require
from cavbench.checks.randomness import stir_others
from cavbench.core.contracts import QueryBudgetError
from cavbench.detection import PatchAttack, PatchOracle, PatchThreat
from cavbench.detection.access import PatchEnforcer
from cavbench.detection.checks.street import SignDetector, Street
from cavbench.errors import UserError
from cavbench.identity.fingerprint import state_digest

QUERIES = 160
"""Query budget of the checks, in images."""
BUDGETS = (0, 1, 10)


class PatchSuite(Suite):
    """Checks of a `PatchAttack`, on a small detector with random weights."""

    component: PatchAttack

    def checks(self) -> Mapping[str, Check]:
        return {
            "shape and type": self.is_a_patch,
            "batching": self.made_once,
            "determinism": self.same_seed_same_patch,
            "seeds": self.seeded_or_not,
            "threat model": self.within_range,
            "query budget": self.within_the_budget,
            "progress": self.tells_how_far_it_is,
            "victim left alone": self.leaves_the_victim,
        }

    def is_a_patch(self) -> str:
        """The patch is [3, P, P] texels, or None."""
        answer, oracle = self._craft()
        if answer is None:
            return "it makes no patch"
        require(isinstance(answer, Tensor), f"craft returned a {type(answer).__name__}, not a tensor")
        try:
            oracle.threat.project(answer)
        except UserError as error:
            raise BrokenRuleError(one_line(error)) from None
        require(answer.is_floating_point(), f"the patch is {answer.dtype}: return float32")
        broken = int((~answer.isfinite()).sum())
        require(not broken, f"{broken} of {answer.numel()} texels are NaN or infinite")
        return ""

    def made_once(self) -> None:
        """Skipped: a patch is not crafted per episode."""
        raise NotApplicableError("a patch is crafted once, not per episode")

    def same_seed_same_patch(self) -> None:
        """All random numbers come from the generators of the run."""
        first, second = self._craft(stir=1)[0], self._craft(stir=2)[0]
        require(
            _equal(first, second),
            "the same seed gave two patches: draw with generator=oracle.generator, and store nothing on the object",
        )

    def seeded_or_not(self) -> None:
        """`seeded` says whether the patch depends on the seed; a run then repeats only what differs."""
        same = _equal(self._craft()[0], self._craft(seed=1)[0])
        if self.component.seeded:
            require(not same, "another seed gives the same patch: set seeded = False")
        else:
            require(same, "another seed gives another patch: set seeded = True")

    def within_range(self) -> str:
        """Texels outside [0, 1] are clipped; records contain how far outside they were."""
        outside = 0.0
        for budget in (0.5, 1.0):
            answer, oracle = self._craft(PatchThreat(budget=budget, queries=QUERIES))
            outside = max(outside, oracle.threat.project(answer)[1] if answer is not None else 0.0)
        return f"texels up to {outside:.2g} outside [0, 1], clipped: return patch.clamp(0, 1)" if outside else ""

    def within_the_budget(self) -> str:
        """It works within any query budget."""
        for queries in BUDGETS:
            try:
                self._craft(PatchThreat(queries=queries))
            except QueryBudgetError as error:
                raise BrokenRuleError(
                    f"{one_line(error)}: check oracle.remaining before a query, and return the best patch so far"
                ) from None
        return f"{self._craft()[1].spent} of {QUERIES} images"

    def tells_how_far_it_is(self) -> None:
        """The reported progress is in [0, 1] and does not decrease."""
        shares: list[float] = []
        self._craft(shares=shares)
        require(all(0 <= share <= 1 for share in shares), "progress was called with a share outside [0, 1]")
        require(shares == sorted(shares), "progress was called with a share below the previous one")

    def leaves_the_victim(self) -> None:
        """It changes neither the weights nor the mode of the detector, nor the scenes."""
        detector, scenes = SignDetector(), Street()
        frames = torch.arange(len(scenes))
        before, pictures = state_digest(detector), scenes.render(frames, None, 1.0)
        self._craft(detector=detector, scenes=scenes)
        require(state_digest(detector) == before, "the detector's weights changed: craft may only query the oracle")
        marks = detector.training or any(weight.requires_grad for weight in detector.parameters())
        require(not marks, "the detector's mode or gradients changed: craft may only query the oracle")
        require(torch.equal(scenes.render(frames, None, 1.0), pictures), "the scenes were changed in place")

    def _craft(
        self,
        threat: PatchThreat | None = None,
        *,
        seed: int = 0,
        stir: int = 0,
        shares: list[float] | None = None,
        detector: SignDetector | None = None,
        scenes: Street | None = None,
    ) -> tuple[Tensor | None, PatchOracle]:
        threat = threat or PatchThreat(queries=QUERIES)
        shares = [] if shares is None else shares
        generator = torch.Generator().manual_seed(seed)
        oracle = PatchEnforcer(detector or SignDetector(), threat, self.component.access, generator).oracle
        with torch.random.fork_rng(devices=[]):
            # Before crafting, a run seeds torch and no other library.
            torch.manual_seed(seed)
            stir_others(stir)
            try:
                return self.component.craft(
                    oracle, scenes or Street(), lambda share, text: shares.append(share)
                ), oracle
            except QueryBudgetError:
                raise
            except UserError as error:
                raise BrokenRuleError(one_line(error)) from None


def _equal(first: Tensor | None, second: Tensor | None) -> bool:
    if first is None or second is None:
        return first is second
    return torch.equal(first, second)
