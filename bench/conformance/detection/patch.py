"""The rules for attacks that make a patch."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from bench.conformance.check import BrokenRuleError, Check, NotApplicableError, Suite, one_line, require
from bench.conformance.detection.street import SignDetector, Street
from bench.conformance.randomness import stir_others
from bench.detection import PatchAttack, PatchOracle, PatchThreat
from bench.errors import UserError
from bench.plugins.contracts import QueryBudgetError
from bench.plugins.fingerprint import state_digest

QUERIES = 160
"""Most pictures that a check lets the detector be asked about."""
BUDGETS = (0, 1, 10)


class PatchSuite(Suite):
    """Of a `PatchAttack`, on a small detector with random weights."""

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
        """[3, P, P] of texels, or None for none."""
        answer, oracle = self._craft()
        if answer is None:
            return "it leaves the sign alone"
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
        """There is no batch of episodes."""
        raise NotApplicableError("a patch is made once, not an episode at a time")

    def same_seed_same_patch(self) -> None:
        """Only the run's generators decide what is drawn."""
        first, second = self._craft(stir=1)[0], self._craft(stir=2)[0]
        require(
            _equal(first, second),
            "the same seed made two patches: draw with generator=oracle.generator, keep no state between patches",
        )

    def seeded_or_not(self) -> None:
        """`seeded` says whether another seed makes another patch, so that seeds are not spent for nothing."""
        same = _equal(self._craft()[0], self._craft(seed=1)[0])
        if self.component.seeded:
            require(not same, "another seed makes the same patch: set seeded = False")
        else:
            require(same, "another seed makes another patch: set seeded = True")

    def within_range(self) -> str:
        """Texels outside [0, 1] are clipped, and recorded."""
        outside = 0.0
        for budget in (0.5, 1.0):
            answer, oracle = self._craft(PatchThreat(budget=budget, queries=QUERIES))
            outside = max(outside, oracle.threat.project(answer)[1] if answer is not None else 0.0)
        return f"texels up to {outside:.2g} outside [0, 1], clipped: return patch.clamp(0, 1)" if outside else ""

    def within_the_budget(self) -> str:
        """However few pictures it may ask about, it does with them."""
        for queries in BUDGETS:
            try:
                self._craft(PatchThreat(queries=queries))
            except QueryBudgetError as error:
                raise BrokenRuleError(
                    f"{one_line(error)}: look at oracle.remaining before asking, and return what is best so far"
                ) from None
        return f"{self._craft()[1].spent} of {QUERIES} pictures"

    def tells_how_far_it_is(self) -> None:
        """The share done is in [0, 1] and does not fall."""
        told: list[float] = []
        self._craft(told=told)
        require(all(0 <= share <= 1 for share in told), "progress was told a share outside [0, 1]")
        require(told == sorted(told), "progress was told a share below the one before")

    def leaves_the_victim(self) -> None:
        """The detector's weights and mode, and the scenes, are as they were."""
        detector, scenes = SignDetector(), Street()
        frames = torch.arange(len(scenes))
        before, pictures = state_digest(detector), scenes.render(frames, None, 1.0)
        self._craft(detector=detector, scenes=scenes)
        require(state_digest(detector) == before, "the detector's weights changed: craft may only ask the oracle")
        marks = detector.training or any(weight.requires_grad for weight in detector.parameters())
        require(not marks, "the detector's mode or gradients changed: craft may only ask the oracle")
        require(torch.equal(scenes.render(frames, None, 1.0), pictures), "the scenes were changed in place")

    def _craft(
        self,
        threat: PatchThreat | None = None,
        *,
        seed: int = 0,
        stir: int = 0,
        told: list[float] | None = None,
        detector: SignDetector | None = None,
        scenes: Street | None = None,
    ) -> tuple[Tensor | None, PatchOracle]:
        threat = threat or PatchThreat(queries=QUERIES)
        told = [] if told is None else told
        generator = torch.Generator().manual_seed(seed)
        oracle = PatchOracle(detector or SignDetector(), threat, self.component.access, generator)
        with torch.random.fork_rng(devices=[]):
            # A run seeds torch before it crafts, and no other library.
            torch.manual_seed(seed)
            stir_others(stir)
            try:
                return self.component.craft(oracle, scenes or Street(), lambda share, text: told.append(share)), oracle
            except QueryBudgetError:
                raise
            except UserError as error:
                raise BrokenRuleError(one_line(error)) from None


def _equal(first: Tensor | None, second: Tensor | None) -> bool:
    if first is None or second is None:
        return first is second
    return torch.equal(first, second)
