"""Unreal's coordinates and ours, the sign's face out of its bounding box, its box in the picture and its visible share."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.camera import sign
from envs.camera.camera import Array, Camera
from envs.camera.carla.geometry import Face, Place, decoded_depth, stand

METRES = st.floats(-1000, 1000)
PLACES = st.builds(Place, st.tuples(METRES, METRES, METRES), st.floats(-180, 180))


@given(place=PLACES, point=st.tuples(METRES, METRES, METRES))
def test_there_and_back_is_the_same_point(place: Place, point: tuple[float, float, float]) -> None:
    assert place.from_unreal(place.to_unreal(np.array(point))) == pytest.approx(np.array(point), abs=1e-9)


def test_unreal_has_forward_first_and_right_second() -> None:
    points = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    assert Place((0, 0, 0), 0.0).to_unreal(points) == pytest.approx(points[[1, 0, 2]])


def test_a_yaw_of_90_drives_along_unreals_y_with_its_right_hand_at_minus_x() -> None:
    place = Place((10.0, 20.0, 3.0), 90.0)
    assert place.to_unreal(np.array([1.0, 5.0, 2.0])) == pytest.approx(np.array([9.0, 25.0, 5.0]))


def box_of(place: Place, x: float, z: tuple[float, float], side: float, thickness: float = 0.06) -> Array:
    """[8, 3] vertices in Unreal's world of the box around a sign at our x, with its face about y = 0."""
    edges = itertools.product((x - side / 2, x + side / 2), (-thickness / 2, thickness / 2), z)
    return place.to_unreal(np.array(list(edges)))


@given(place=PLACES, off=st.floats(-60, 60))
def test_the_place_and_the_face_come_out_of_the_signs_box(place: Place, off: float) -> None:
    vertices = box_of(place, 2.475, (2.1, 2.85), 0.75)
    found, face = stand(vertices, road_yaw_deg=place.yaw_deg + off, road_z=place.origin[2], sign_x=2.475)
    assert found.origin == pytest.approx(place.origin, abs=1e-6)
    turned = (found.yaw_deg - place.yaw_deg + 180) % 360 - 180
    assert turned == pytest.approx(0, abs=1e-6)
    assert (face.x, face.z, face.side) == pytest.approx((2.475, 2.475, 0.75), abs=1e-6)


def test_of_a_box_with_the_post_in_it_the_face_is_the_upper_end() -> None:
    place = Place((0, 0, 0), 30.0)
    _, face = stand(box_of(place, 3.0, (0.0, 2.9), 0.8), road_yaw_deg=30.0, road_z=0.0, sign_x=3.0)
    assert (face.z, face.side) == pytest.approx((2.5, 0.8))


def test_a_sign_as_large_as_the_embedded_worlds_has_its_box() -> None:
    camera, face = Camera(y=-20.0), Face(2.475, sign.HEIGHT_M, sign.SIZE_M)
    assert face.box(camera) == pytest.approx(sign.box(2.475, camera))


def test_a_box_is_clipped_to_the_picture() -> None:
    camera = Camera(y=-3.0)
    x1, y1, x2, y2 = Face(2.475, 2.7, 1.2).box(camera)
    assert 0 <= x1 <= x2 <= camera.width
    assert 0 <= y1 <= y2 <= camera.height
    assert y1 == 0


def plane(camera: Camera, y: float) -> Array:
    """[H, W] depth of a wall across the road at y."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(columns - camera.width / 2), rows - camera.height / 2, np.full_like(rows, camera.focal)], -1)
    along = (rays / camera.focal) @ camera.rotation
    return (y - camera.y) / along[..., 1]


def test_a_sign_with_nothing_before_it_is_seen_whole() -> None:
    camera = Camera(y=-20.0)
    assert Face(2.475, 2.7, 1.2).visible(camera, plane(camera, 0.0)) == 1.0


def test_a_sign_behind_a_lorry_or_not_where_it_is_said_to_be_is_not_seen() -> None:
    camera = Camera(y=-20.0)
    for wall in (-5.0, 5.0):
        assert Face(2.475, 2.7, 1.2).visible(camera, plane(camera, wall)) == 0.0


def test_what_hides_the_left_half_of_a_sign_leaves_half() -> None:
    camera, face = Camera(y=-20.0), Face(2.475, 2.7, 1.2)
    depth = plane(camera, 0.0)
    middle = camera.project(np.array([[face.x, 0.0, face.z]]))[0, 0]
    depth[:, : round(middle)] = 4.0
    assert face.visible(camera, depth) == pytest.approx(0.5, abs=0.03)


def test_what_is_outside_the_picture_is_not_seen() -> None:
    camera = Camera(y=-8.0, pitch_deg=0.0)
    top = camera.z + 8.0 * camera.height / 2 / camera.focal
    assert Face(0.0, top, 1.2).visible(camera, plane(camera, 0.0)) == pytest.approx(0.5, abs=0.03)
    assert Face(0.0, top + 2.0, 1.2).visible(camera, plane(camera, 0.0)) == 0.0


def test_depth_is_decoded_from_three_bytes() -> None:
    metres = np.array([[0.0, 12.34, 999.9], [1000.0, 0.001, 500.0]])
    code = np.round(metres / 1000 * (2**24 - 1)).astype(np.int64)
    bgra = np.stack([code >> 16, (code >> 8) & 255, code & 255, np.full_like(code, 255)], -1).astype(np.uint8)
    assert decoded_depth(bgra) == pytest.approx(metres, abs=1e-4)
