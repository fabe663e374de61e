"""Random textures, as examples of what does not belong into a scene. No attack and no detector is involved."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Generator, Tensor
from torch.nn.functional import interpolate


def textures(count: int, side: int, clean: Tensor, generator: Generator) -> Tensor:
    """Textures [count, 3, side, side] in [0, 1], each of a random kind and in random light.

    Args:
        count: number of textures.
        side: width and height in texels.
        clean: uint8 [M, 3, H, W], images of which squares are one kind of texture.
        generator: random generator.
    """
    kinds: tuple[Callable[[int, Generator], Tensor], ...] = (_blocks, _clouds, _waves, _flat)
    drawn = torch.randint(len(kinds) + 1, (count,), generator=generator).tolist()
    found = [kinds[kind](side, generator) if kind < len(kinds) else _square(clean, side, generator) for kind in drawn]
    low = 0.4 * torch.rand(count, 1, 1, 1, generator=generator)
    high = 1 - 0.4 * torch.rand(count, 1, 1, 1, generator=generator)
    return low + (high - low) * torch.stack(found)


def _blocks(side: int, generator: Generator) -> Tensor:
    """Blocks of uniformly random colours, from one texel to a quarter of the side."""
    cells = int(torch.randint(4, side + 1, (1,), generator=generator))
    return interpolate(torch.rand(1, 3, cells, cells, generator=generator), (side, side))[0]


def _clouds(side: int, generator: Generator) -> Tensor:
    """Coloured noise whose spectrum falls as a random power of the frequency."""
    power = 0.5 + 2 * float(torch.rand(1, generator=generator))
    frequency = torch.fft.fftfreq(side).square()
    radius = (frequency[:, None] + frequency).sqrt()
    radius[0, 0] = torch.inf
    noise = torch.fft.ifft2(torch.fft.fft2(torch.randn(3, side, side, generator=generator)) / radius**power).real
    return (2 * noise / noise.std().clamp(min=1e-6)).sigmoid()


def _waves(side: int, generator: Generator) -> Tensor:
    """Stripes or checks in two random colours."""
    at = torch.arange(side) / side
    cycles = 12 * torch.rand(2, 2, generator=generator) - 6
    one, two = (torch.sin(2 * math.pi * (a * at[:, None] + b * at)) for a, b in cycles.tolist())
    sharp = 10 ** (2 * float(torch.rand(1, generator=generator)))
    mixed = (sharp * (one if torch.rand(1, generator=generator) < 0.5 else one * two)).sigmoid()
    colours = torch.rand(2, 3, 1, 1, generator=generator)
    return torch.lerp(colours[0], colours[1], mixed)


def _flat(side: int, generator: Generator) -> Tensor:
    """One colour."""
    return torch.rand(3, 1, 1, generator=generator).expand(3, side, side)


def _square(clean: Tensor, side: int, generator: Generator) -> Tensor:
    """A square of a clean image, from another place."""
    count, _, height, width = clean.shape
    frame = int(torch.randint(count, (1,), generator=generator))
    size = int(torch.randint(16, min(height, width) // 2, (1,), generator=generator))
    y, x = (int(torch.randint(limit - size, (1,), generator=generator)) for limit in (height, width))
    return interpolate(clean[None, frame, :, y : y + size, x : x + size].float() / 255, (side, side))[0]
