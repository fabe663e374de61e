"""The patch oracle counts queries, enforces access and passes gradients; a patch has texels in [0, 1]."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavbench.core.contracts import Access, QueryBudgetError
from cavbench.detection import PatchOracle, PatchThreat
from cavbench.detection.access import PatchEnforcer
from cavbench.detection.patch import MOMENTS, Patch
from cavbench.detection.threat import GREY
from cavbench.errors import UserError
from tests.plugins.toy_camera import RedDetector


def oracle(access: Access = "gradients", queries: int = 100) -> PatchOracle:
    return PatchEnforcer(RedDetector(), PatchThreat(queries=queries), access, torch.Generator()).oracle


def pictures(count: int) -> Tensor:
    return torch.rand(count, 3, 32, 32, generator=torch.Generator().manual_seed(count))


@given(asked=st.lists(st.tuples(st.integers(0, 9), st.booleans()), max_size=12), queries=st.integers(0, 40))
@settings(deadline=None)
def test_every_image_is_a_query_and_the_budget_is_enforced(asked: list[tuple[int, bool]], queries: int) -> None:
    door, spent = oracle(queries=queries), 0
    for count, differentiable in asked:
        ask = door.differentiable if differentiable else door.predict
        if spent + count > queries:
            with pytest.raises(QueryBudgetError, match=f"asked about {spent + count} images"):
                ask(pictures(count))
        else:
            assert len(ask(pictures(count)).boxes) == count
            spent += count
        assert (door.spent, door.remaining) == (spent, queries - spent)


@pytest.mark.parametrize(("access", "allowed"), [("oblivious", 0), ("decisions", 0), ("scores", 1), ("gradients", 2)])
def test_calls_above_the_access_level_are_refused(access: Access, allowed: int) -> None:
    door = oracle(access)
    for number, ask in enumerate((door.predict, door.differentiable)):
        if number < allowed:
            ask(pictures(1))
        else:
            with pytest.raises(UserError, match=f"declares only '{access}'"):
                ask(pictures(1))
    assert door.spent == allowed


def test_gradients_reach_the_pixels_and_are_counted() -> None:
    enforcer = PatchEnforcer(RedDetector(), PatchThreat(), "gradients", torch.Generator())
    door, shown = enforcer.oracle, pictures(3).requires_grad_(True)
    assert not door.predict(shown).scores.requires_grad
    door.differentiable(shown).scores[..., door.label].sum().backward()
    assert shown.grad is not None
    assert shown.grad.abs().sum() > 0
    assert (door.spent, enforcer.backwards) == (6, 3)


TEXELS = st.one_of(st.floats(-3, 4, width=32), st.sampled_from([torch.nan, torch.inf, -torch.inf]))


@settings(deadline=None)
@given(values=st.lists(TEXELS, min_size=12, max_size=12), side=st.sampled_from([8, 16, 100]))
def test_texels_are_clipped_and_the_excess_is_the_largest_distance(values: list[float], side: int) -> None:
    given_ = torch.tensor(values).repeat(3 * side * side // 12 + 1)[: 3 * side * side].reshape(3, side, side)
    patch, excess = PatchThreat().project(given_)
    assert patch.shape == given_.shape
    assert ((patch >= 0) & (patch <= 1)).all()
    known = given_.isfinite()
    assert torch.equal(patch[known], given_[known].clamp(0, 1))
    assert (patch[~known] == GREY).all()
    assert excess == pytest.approx(max([0.0, *(max(v - 1, -v) for v in given_[known].tolist())]))


@pytest.mark.parametrize("shape", [(3, 7, 7), (3, 8, 9), (1, 8, 8), (8, 8), (1, 3, 8, 8), (3, 513, 513)])
def test_an_invalid_patch_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(UserError, match="a patch must be"):
        PatchThreat().project(torch.zeros(shape))


@settings(deadline=None)
@given(steps=st.integers(1, 500))
def test_reported_steps_are_few_and_evenly_spaced(steps: int) -> None:
    door = oracle("oblivious")
    for step in range(steps):
        more = {"odd": 1.0} if step % 2 else {}
        door.report(
            torch.full((3, 8, 8), step / steps), loss=torch.tensor(step, requires_grad=True, dtype=float), **more
        )
    kept = door.reports.evolution
    assert kept is not None
    apart = kept.steps.diff().unique().tolist()
    assert kept.steps[0] == 0
    assert len(apart) <= 1
    assert steps - kept.steps[-1] <= max(apart, default=1)
    assert min(steps, MOMENTS // 2) <= len(kept.steps) <= MOMENTS
    assert torch.equal(kept.losses["loss"], kept.steps.float())
    assert torch.equal(kept.texels[:, 0, 0, 0], (255 * (kept.steps.float() / steps)).round().byte())
    assert "odd" not in kept.losses or torch.equal(kept.losses["odd"].isnan(), kept.steps % 2 == 0)
    assert door.spent == 0


def test_reported_patches_must_have_one_size() -> None:
    door = oracle("oblivious")
    assert door.reports.evolution is None
    door.report(torch.zeros(3, 8, 8))
    with pytest.raises(UserError, match="reported patches of 8 and 9 texels"):
        door.report(torch.zeros(3, 9, 9))
    with pytest.raises(UserError, match="a patch must be"):
        door.report(torch.zeros(1, 3, 8, 8))


@pytest.mark.parametrize("value", ["[" * 50_000 + "]" * 50_000, "3", '"one"', "1e999", '"1", "queries": "2"'])
def test_a_patch_file_of_another_form_is_refused_in_one_line(value: str) -> None:
    content = Patch(torch.rand(3, 4, 4), queries=7).written("{}")
    size = int.from_bytes(content[:8], "little")
    header = content[8 : 8 + size].replace(b'"queries":"7"', f'"queries":{value}'.encode())
    with pytest.raises(UserError, match="truncated or foreign"):
        Patch.read(len(header).to_bytes(8, "little") + header + content[8 + size :])


def test_a_detector_whose_gradient_is_nan_in_one_pixel_is_attacked_through_the_others() -> None:
    class Spotted(RedDetector):
        def forward(self, pictures: Tensor) -> object:
            return super().forward(pictures + 0.0 * (pictures - pictures.detach()).abs().sqrt() * spot)

    pictures = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    spot = torch.zeros(3, 32, 32)
    spot[0, 5, 6] = 1.0
    gradients = []
    for detector in (RedDetector(), Spotted()):
        enforcer = PatchEnforcer(detector.eval(), PatchThreat(), "gradients", torch.Generator())
        leaf = pictures.clone().requires_grad_(True)
        enforcer.oracle.differentiable(leaf).objectness.sum().backward()
        assert leaf.grad is not None
        gradients.append(leaf.grad)
    assert bool(gradients[0].any())
    assert torch.equal(gradients[1], gradients[0].masked_fill(gradients[1] == 0, 0.0))
    assert (enforcer.backwards, enforcer.nans) == (2, 2)


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, pickle.dumps])
def test_an_oracle_cannot_be_copied_with_the_detector_behind_it(duplicate: Callable[[PatchOracle], object]) -> None:
    with pytest.raises(TypeError, match="cannot be copied"):
        duplicate(oracle())
