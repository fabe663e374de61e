"""How a car with tyres that slip moves: highway-env's vehicle/dynamics.py, a dynamic bicycle model (Rajamani 2011, chapter 2).

Its state also has a lateral speed and a yaw rate. highway-env never applies the push of a collision to it.
"""

from __future__ import annotations

import math

from cavbench.compiled import inner, rounded_once
from cavbench.envs.highway.dynamics import clip
from cavbench.envs.roads.lanes import update_lane
from cavbench.envs.roads.motion import clip_actions, update_direction
from cavbench.envs.roads.state import Body, Road

FRONT = REAR = 2.5
"""Distances of the axles from the centre of mass in m."""
STIFFNESS = 15.0
"""Cornering stiffness of a tyre for a mass of 1 kg, in N/rad."""
INERTIA = 1 / 12 * (5.0**2 + 2.0**2)
"""Moment of inertia about the vertical axis for a mass of 1 kg, in kg m2."""
FASTEST_YAW = 2 * math.pi
"""Highest yaw rate in rad/s."""
SLOW = 1.0
"""Below this speed in m/s the tyres only damp."""


@rounded_once
def turned(cosine: float, sine: float, along: float, across: float) -> float:
    """A component of a rotated vector, rounded as BLAS does on processors with fused operations."""
    return cosine * along + sine * across


@inner
def change(
    heading: float, speed: float, lateral: float, yaw: float, steering: float
) -> tuple[float, float, float, float]:
    """BicycleVehicle.derivative_func: of x, y, lateral speed and yaw rate; that of the heading is the yaw rate."""
    if abs(speed) < SLOW:
        front = -lateral - INERTIA / FRONT * yaw
        rear = -lateral + INERTIA / FRONT * yaw
    else:
        front = 2 * STIFFNESS * (steering - math.atan2(lateral + FRONT * yaw, speed))
        rear = 2 * STIFFNESS * (0.0 - math.atan2(lateral - REAR * yaw, speed))
    cosine, sine = math.cos(heading), math.sin(heading)
    return (
        turned(cosine, -sine, speed, lateral),
        turned(sine, cosine, speed, lateral),
        (front + rear) - yaw * speed,
        1 / INERTIA * (FRONT * front - REAR * rear),
    )


@inner
def slide(road: Road, body: Body, dt: float) -> None:
    """BicycleVehicle.step: one frame by the classic Runge-Kutta method."""
    clip_actions(body)
    body.steering = clip(body.steering, -math.pi / 2, math.pi / 2)
    body.yaw_rate = clip(body.yaw_rate, -FASTEST_YAW, FASTEST_YAW)
    steering, push = body.steering, body.acceleration
    heading, speed, lateral, yaw = body.heading, body.speed, body.lateral_speed, body.yaw_rate
    half = dt / 2
    x1, y1, l1, r1 = change(heading, speed, lateral, yaw, steering)
    h2, v2, s2, w2 = heading + yaw * half, speed + push * half, lateral + l1 * half, yaw + r1 * half
    x2, y2, l2, r2 = change(h2, v2, s2, w2, steering)
    h3, v3, s3, w3 = heading + w2 * half, speed + push * half, lateral + l2 * half, yaw + r2 * half
    x3, y3, l3, r3 = change(h3, v3, s3, w3, steering)
    h4, v4, s4, w4 = heading + w3 * dt, speed + push * dt, lateral + l3 * dt, yaw + r3 * dt
    x4, y4, l4, r4 = change(h4, v4, s4, w4, steering)
    sixth = dt / 6
    body.x += sixth * (x1 + 2 * x2 + 2 * x3 + x4)
    body.y += sixth * (y1 + 2 * y2 + 2 * y3 + y4)
    body.heading += sixth * (yaw + 2 * w2 + 2 * w3 + w4)
    body.speed += sixth * (push + 2 * push + 2 * push + push)
    body.lateral_speed += sixth * (l1 + 2 * l2 + 2 * l3 + l4)
    body.yaw_rate += sixth * (r1 + 2 * r2 + 2 * r3 + r4)
    update_direction(body)
    update_lane(body, road)
