"""The pinhole camera behind the windscreen, and projection into its image.

World coordinates: x to the right, y along the road, z up, in metres; the sign's face is in the plane y = 0 and looks towards -y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera that looks along the road.

    Width, focal length and height are those of the KITTI recordings, with the image cropped to multiples of 32 (Geiger et al.
    2013, "Vision meets robotics", section 2: 1242 x 375 pixels, f = 721 pixels, 1.65 m above the road).

    Args:
        x: position to the right of the middle of the ego's lane, in m.
        y: position along the road in m; negative before the sign.
        z: height above the road in m.
        yaw_deg: yaw to the right.
        pitch_deg: pitch upwards.
        width, height: size of the image in pixels.
        focal: focal length in pixels.
    """

    x: float = 0.0
    y: float
    z: float = 1.65
    yaw_deg: float = 0.0
    pitch_deg: float = 1.0
    width: int = 1248
    height: int = 384
    focal: float = 721.0

    @property
    def position(self) -> Array:
        """Position [3] in m."""
        return np.array([self.x, self.y, self.z])

    @property
    def forward(self) -> Array:
        """Unit vector [3] of the optical axis."""
        yaw, pitch = np.deg2rad(self.yaw_deg), np.deg2rad(self.pitch_deg)
        return np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])

    @property
    def rotation(self) -> Array:
        """Rotation matrix [3, 3] from world to camera axes: right, down, forward."""
        forward = self.forward
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    @property
    def field_of_view_deg(self) -> float:
        """Horizontal field of view in degrees."""
        return float(np.rad2deg(2 * np.arctan(self.width / 2 / self.focal)))

    def project(self, points: Array) -> Array:
        """Pixel coordinates [N, 2] of world points [N, 3] in front of the camera; (0, 0) is the top left corner of the image."""
        seen = (points - self.position) @ self.rotation.T
        return seen[:, :2] / seen[:, 2:] * self.focal + np.array([self.width, self.height]) / 2
