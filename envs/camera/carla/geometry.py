"""Where the sign of a CARLA map is, in Unreal's coordinates and in ours, and how much of it a camera sees.

Ours are right-handed, x to the right, y along the road, z up (`envs.camera.camera`); Unreal's are left-handed, x forward,
y to the right, z up, with yaw from x towards y. Both are in metres at the client.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.camera import sign
from envs.camera.camera import Array, Camera

DEPTH_TOLERANCE_M = 0.5
"""Of a sign's point: what is farther off than this before or behind it is something else."""
_POINTS = 64
"""Along a side of the square on which the octagon's visible share is sampled."""


@dataclass(frozen=True)
class Place:
    """Where our coordinates lie in CARLA's: the middle of the ego's lane beside the sign, and the direction of driving.

    Args:
        origin: [3] our (0, 0, 0) in Unreal's world, in m.
        yaw_deg: of the direction of driving, as Unreal counts it.
    """

    origin: tuple[float, float, float]
    yaw_deg: float

    @property
    def _axes(self) -> Array:
        """[3, 3] our right, forward and up in Unreal's world, one a row."""
        forward = _heading(self.yaw_deg)
        return np.array([[-forward[1], forward[0], 0.0], [forward[0], forward[1], 0.0], [0.0, 0.0, 1.0]])

    def to_unreal(self, points: Array) -> Array:
        """Our points [..., 3] in Unreal's world."""
        return points @ self._axes + np.array(self.origin)

    def from_unreal(self, points: Array) -> Array:
        """Points [..., 3] of Unreal's world in ours."""
        return (points - np.array(self.origin)) @ self._axes.T


@dataclass(frozen=True)
class Face:
    """A sign's octagon in the plane y = 0: its middle's x and z and its side across flats, in m."""

    x: float
    z: float
    side: float

    @property
    def corners(self) -> Array:
        """[8, 3] in our coordinates."""
        unit = (sign.corners(0.0) - np.array([0.0, 0.0, sign.HEIGHT_M])) / sign.SIZE_M
        return unit * self.side + np.array([self.x, 0.0, self.z])

    def box(self, camera: Camera) -> Array:
        """[4] x1, y1, x2, y2 in pixels, clipped to the picture."""
        seen = camera.project(self.corners)
        edges = np.array([camera.width, camera.height])
        return np.concatenate([seen.min(0).clip(0, edges), seen.max(0).clip(0, edges)])

    def visible(self, camera: Camera, depth: NDArray[np.floating]) -> float:
        """Share of the octagon that is in the picture with nothing before it, in [0, 1].

        A point counts where the depth picture holds its own depth, within `DEPTH_TOLERANCE_M`.

        Args:
            camera: that took the depth picture.
            depth: [H, W] along the optical axis, in m.
        """
        line = (np.arange(_POINTS) + 0.5) / _POINTS
        square = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
        across, down = ((square[sign.inside(square)] - 0.5) * self.side).T
        points = np.stack([self.x + across, np.zeros_like(across), self.z - down], 1)
        expected = (points - camera.position) @ camera.rotation[2]
        column, row = np.floor(camera.project(points)).astype(int).T
        framed = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        seen = depth[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)]
        return float((framed & (np.abs(seen - expected) < DEPTH_TOLERANCE_M)).mean())


def stand(vertices: Array, *, road_yaw_deg: float, road_z: float, sign_x: float) -> tuple[Place, Face]:
    """Our coordinates at a sign of the map, and its face in them.

    The face is the box's long side seen from above, and looks against the traffic. An octagon is as high as it is wide: of a
    box that is higher, because the post is in it, the face is the upper end.

    Args:
        vertices: [8, 3] of the sign's bounding box in Unreal's world, in m.
        road_yaw_deg: of the lane beside the sign; it only says which of the face's two sides is meant.
        road_z: height of that lane in m.
        sign_x: of the sign to the right of the ego, in m.
    """
    ground = vertices[:, :2] - vertices[:, :2].mean(0)
    thin, wide = np.linalg.eigh(ground.T @ ground)[1].T
    forward = thin if thin @ _heading(road_yaw_deg) > 0 else -thin
    side = float(np.ptp(ground @ wide))
    low, high = float(vertices[:, 2].min()), float(vertices[:, 2].max())
    right = np.array([-forward[1], forward[0]])
    x, y = vertices[:, :2].mean(0) - right * sign_x
    place = Place((float(x), float(y), road_z), float(np.rad2deg(np.arctan2(forward[1], forward[0]))))
    return place, Face(sign_x, max((low + high) / 2, high - side / 2) - road_z, side)


def _heading(yaw_deg: float) -> Array:
    """[2] unit vector of a yaw, over Unreal's x and y."""
    yaw = np.deg2rad(yaw_deg)
    return np.array([np.cos(yaw), np.sin(yaw)])


def decoded_depth(picture: NDArray[np.uint8]) -> Array:
    """[H, W] metres of a depth camera's picture [H, W, 4] BGRA: 1000 m (R + 256 G + 65536 B) / (2^24 - 1)."""
    blue, green, red = picture[..., :3].astype(np.float64).transpose(2, 0, 1)
    return 1000 * (red + 256 * green + 65536 * blue) / (2**24 - 1)
