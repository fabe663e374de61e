"""Parts written into pictures: the same pixels and the same gradient as with plain assignments."""

from __future__ import annotations

import torch
from torch import Tensor

from cavbench.envs.camera.layers import Where, joined

PLACES: list[Where] = [(0, slice(2, 5), slice(1, 4)), (2, slice(0, 1), slice(0, 6)), (2, slice(3, 6), slice(4, 6))]


def drawn() -> tuple[Tensor, list[Tensor], Tensor]:
    generator = torch.Generator().manual_seed(0)
    parts = [
        torch.rand(3, rows.stop - rows.start, columns.stop - columns.start, generator=generator).requires_grad_()
        for _, rows, columns in PLACES
    ]
    pictures, weights = (torch.rand(3, 3, 6, 6, generator=generator) for _ in range(2))
    return pictures, parts, weights


def test_pixels_and_gradients_are_those_of_assignments() -> None:
    pictures, parts, weights = drawn()
    assigned = pictures.clone()
    for (number, rows, columns), part in zip(PLACES, parts, strict=True):
        assigned[number, :, rows, columns] = part.square()
    wanted = torch.autograd.grad((assigned * weights).sum(), parts)
    found = joined(pictures, PLACES, [part.square() for part in parts])
    assert torch.equal(found, assigned)
    for own, other in zip(torch.autograd.grad((found * weights).sum(), parts), wanted, strict=True):
        assert torch.equal(own, other)


def test_without_parts_or_graph_the_pictures_need_no_gradient() -> None:
    pictures, parts, _ = drawn()
    assert torch.equal(joined(pictures.clone(), [], []), pictures)
    with torch.no_grad():
        assert not joined(pictures, PLACES, parts).requires_grad
    assert torch.equal(pictures[0, :, 2:5, 1:4], parts[0])
