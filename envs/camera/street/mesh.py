"""Triangle meshes with texture coordinates, and the basic shapes of the street."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Rng = np.random.Generator


@dataclass(frozen=True)
class Mesh:
    """Vertices [N, 3] in m, triangles [M, 3] of vertex indices, texture coordinates [N, 2]."""

    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    uv: NDArray[np.float32]

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
        """The mesh translated by x, y, z in m."""
        return Mesh(self.vertices + np.array([x, y, z], np.float32), self.triangles, self.uv)


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Join several meshes into one."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    triangles = [mesh.triangles + np.uint32(start) for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(triangles),
        np.concatenate([mesh.uv for mesh in meshes]),
    )


def quad(corners: ArrayLike, uv: ArrayLike = ((0, 0), (1, 0), (1, 1), (0, 1))) -> Mesh:
    """A quadrilateral with corners [4, 3], in order."""
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    return Mesh(np.asarray(corners, np.float32), triangles, np.asarray(uv, np.float32))


def ground(x0: float, x1: float, y0: float, y1: float, z: float, tile: float = 1.0) -> Mesh:
    """A level rectangle whose texture repeats every `tile` metres."""
    corners = np.array([(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)])
    return quad(corners, corners[:, :2] / tile)


def block(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float, tile: tuple[float, float] = (1, 1)) -> Mesh:
    """A box without a floor; the texture repeats every `tile` metres (along, up) on its walls."""
    dx, dy, dz = (x1 - x0) / tile[0], (y1 - y0) / tile[0], (z1 - z0) / tile[1]
    walls = [
        ([(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)], dx, dz),
        ([(x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1)], dx, dz),
        ([(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)], dy, dz),
        ([(x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1)], dy, dz),
        ([(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)], dx, dy),
    ]
    return join([quad(corners, [(0, 0), (u, 0), (u, v), (0, v)]) for corners, u, v in walls])


def sweep(rings: NDArray[np.floating]) -> Mesh:
    """A closed surface through rings [K, N, 3] of points, with both ends filled."""
    count, around = rings.shape[:2]
    ends = [rings[0].mean(0), rings[-1].mean(0)]
    vertices = np.concatenate([rings.reshape(-1, 3), ends])
    ring, point = np.meshgrid(np.arange(count - 1), np.arange(around), indexing="ij")
    a, b = ring * around + point, ring * around + (point + 1) % around
    sides = np.stack([np.stack([a, b, b + around], -1), np.stack([a, b + around, a + around], -1)])
    first, after = np.arange(around), (np.arange(around) + 1) % around
    last = (count - 1) * around
    caps = [
        np.stack([after, first, np.full(around, count * around)], 1),
        np.stack([last + first, last + after, np.full(around, count * around + 1)], 1),
    ]
    triangles = np.concatenate([sides.reshape(-1, 3), *caps]).astype(np.uint32)
    return Mesh(vertices.astype(np.float32), triangles, np.zeros((len(vertices), 2), np.float32))


def rod(base: ArrayLike, tip: ArrayLike, radius: float, tip_radius: float | None = None, sides: int = 16) -> Mesh:
    """A round post from `base` to `tip` ([3] each)."""
    base, tip = np.asarray(base, float), np.asarray(tip, float)
    axis = (tip - base) / np.linalg.norm(tip - base)
    across = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)[:, None]
    circle = np.cos(angle) * across + np.sin(angle) * np.cross(axis, across)
    return sweep(np.stack([base + radius * circle, tip + (radius if tip_radius is None else tip_radius) * circle]))


def foliage(x: float, y: float, z: float, spread: float, rise: float, leaves: int, rng: Rng, size: float) -> Mesh:
    """Leaf quads in clumps around (x, y, z), `spread` m wide and `rise` m high from the middle."""
    clumps = rng.normal(size=(16, 3))
    clumps *= rng.uniform(0.2, 0.75, (16, 1)) / np.linalg.norm(clumps, axis=1, keepdims=True)
    radii = rng.uniform(0.28, 0.5, 16)
    chosen = rng.integers(0, 16, leaves)
    offset = rng.normal(size=(leaves, 3))
    offset *= (radii[chosen] * np.sqrt(rng.uniform(0.3, 1, leaves)))[:, None] / np.linalg.norm(
        offset, axis=1, keepdims=True
    )
    middle = (clumps[chosen] + offset) * (spread, spread, rise) + (x, y, z)
    along = rng.normal(size=(leaves, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, rng.normal(size=(leaves, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    length = size * rng.uniform(0.6, 1.3, (leaves, 1))
    corners = [middle - along * length, middle - across * length / 2, middle + along * length]
    corners.append(middle + across * length / 2)
    first = 4 * np.arange(leaves)[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])]).astype(np.uint32)
    uv = np.repeat(rng.random((leaves, 1, 2)), 4, 1).reshape(-1, 2)
    return Mesh(np.stack(corners, 1).reshape(-1, 3).astype(np.float32), triangles, uv.astype(np.float32))
