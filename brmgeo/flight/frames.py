"""Turning between the frames that logs are written in and ours: the one place where an axis changes its sign.

Ours are ENU (x east, y north, z up) for the world and FLU (x nose, y left, z up) for the body, REP-103. PX4 and
ArduPilot write NED and FRD. A quaternion is (w, x, y, z), unit length, and named destination_from_source; its sign
is of no meaning. Quaternion algebra after Kuipers, "Quaternions and Rotation Sequences" (1999): written out, because
scipy's Rotation brings what it is given to unit length and refuses zero, while a log's values keep their bits here.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from brmgeo.flight.readings import BODY_FROM_NADIR_CAMERA, FloatArray

QuaternionOrder = Literal["xyzw", "wxyz"]
#: What the axes of a track's world and body may be: ``flu`` (x nose, y left, z up), ``frd`` (x nose, y right, z down),
#: ``optical`` of a camera that looks ahead (x right, y down, z ahead), ``nadir`` of one that looks down (x right, y back,
#: z down; the picture's top is the nose).
Axes = Literal["flu", "frd", "optical", "nadir"]

#: (w, x, y, z) of the half turn about x that takes FRD to FLU (and back), and of the one that takes NED to ENU.
FLU_FROM_FRD: FloatArray = np.array([0.0, 1.0, 0.0, 0.0])
ENU_FROM_NED: FloatArray = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])

#: Below this wander of the vertical (mean length of 1 minus), the order of a quaternion cannot be told from it.
MIN_WANDER = 0.02
#: The better order must wander less than this share of the other.
CLEAR_SHARE = 0.67
#: No vehicle flies beyond this on average, and a body that is not turned in its vehicle stays below that.
UPSIDE_DOWN_DEG, UPRIGHT_DEG = 150.0, 60.0
#: More wander than this is tumbling; more than this is steeper banking than 20 degrees (standard deviation).
MAX_WANDER, MAX_BANKING = 0.2, 0.06


def multiply(first: FloatArray, second: FloatArray) -> FloatArray:
    """(..., 4) the product: ``second`` is applied first, as with matrices. Shapes broadcast."""
    aw, ax, ay, az = np.moveaxis(np.asarray(first, dtype=np.float64), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(second, dtype=np.float64), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def inverse(wxyz: FloatArray) -> FloatArray:
    """(..., 4) the turn back, of unit quaternions."""
    return np.asarray(wxyz, dtype=np.float64) * [1.0, -1.0, -1.0, -1.0]


def rotate(wxyz: FloatArray, vectors: FloatArray) -> FloatArray:
    """(..., 3) ``vectors`` turned by unit quaternions; shapes broadcast."""
    q, v = np.asarray(wxyz, dtype=np.float64), np.asarray(vectors, dtype=np.float64)
    twice = 2.0 * np.cross(q[..., 1:], v)
    return np.asarray(v + q[..., :1] * twice + np.cross(q[..., 1:], twice))


def quaternion_from_matrix(rotation: FloatArray) -> FloatArray:
    """(..., 4) unit quaternions of (..., 3, 3) rotations; one that is rounded counts as the rotation nearest to it."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat()[..., [3, 0, 1, 2]])


def quaternion_from_euler(roll_rad: FloatArray, pitch_rad: FloatArray, yaw_rad: FloatArray) -> FloatArray:
    """(..., 4) quaternion of Rz(yaw) Ry(pitch) Rx(roll): intrinsic yaw-pitch-roll, in FLU and in FRD alike."""
    angles = np.stack(np.broadcast_arrays(yaw_rad, pitch_rad, roll_rad), axis=-1)
    return np.asarray(Rotation.from_euler("ZYX", angles).as_quat()[..., [3, 0, 1, 2]])


def euler_from_quaternion(wxyz: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(...,) roll, pitch and yaw in radians: the inverse of ``quaternion_from_euler`` for pitch within a quarter turn."""
    w, x, y, z = np.moveaxis(np.asarray(wxyz, dtype=np.float64), -1, 0)
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, pitch, yaw


def enu_from_ned(vectors: FloatArray) -> FloatArray:
    """(..., 3) east, north, up of (..., 3) north, east, down."""
    return np.asarray(vectors, dtype=np.float64)[..., [1, 0, 2]] * [1.0, 1.0, -1.0]


def flu_from_frd(vectors: FloatArray) -> FloatArray:
    """(..., 3) in FLU of (..., 3) in FRD: body vectors, or a z-down world whose heading is arbitrary."""
    return np.asarray(vectors, dtype=np.float64) * [1.0, -1.0, -1.0]


def enu_flu_from_ned_frd(wxyz: FloatArray) -> FloatArray:
    """(..., 4) enu_from_flu of (..., 4) ned_from_frd: the attitude as our frames tell it."""
    return multiply(multiply(ENU_FROM_NED, wxyz), FLU_FROM_FRD)


def flu_flu_from_frd_frd(wxyz: FloatArray) -> FloatArray:
    """(..., 4) attitude in a z-up world of one in a z-down world of arbitrary heading (PX4's FRD pose frame)."""
    return multiply(multiply(FLU_FROM_FRD, wxyz), FLU_FROM_FRD)


def to_flu(axes: Axes, xyz: FloatArray, wxyz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(..., 3) places and (..., 4) attitudes in FLU of those whose world and body are both told in other ``axes``."""
    turn = _TO_FLU[axes]
    return rotate(turn, xyz), multiply(multiply(turn, wxyz), inverse(turn))


#: flu_from_axes.
_TO_FLU: dict[str, FloatArray] = {
    "flu": np.array([1.0, 0.0, 0.0, 0.0]),
    "frd": FLU_FROM_FRD,
    "optical": np.array([0.5, -0.5, 0.5, -0.5]),
    "nadir": quaternion_from_matrix(BODY_FROM_NADIR_CAMERA),
}


def heading_deg(wxyz: FloatArray) -> FloatArray:
    """(...,) heading of the nose of enu_from_flu attitudes, degrees clockwise from north, in [0, 360)."""
    yaw = euler_from_quaternion(wxyz)[2]
    return np.asarray((90.0 - np.degrees(yaw)) % 360.0)


def up_in_body(wxyz: FloatArray) -> FloatArray:
    """(3,) mean of the world's up in the body's axes; its length is 1 where the body never leans over differently."""
    return np.asarray(rotate(inverse(wxyz), np.array([0.0, 0.0, 1.0])).mean(axis=0))


def likely_order(values: FloatArray) -> QuaternionOrder | None:
    """The order that (n, 4) quaternion columns are likely in, or None where it cannot be told.

    A vehicle turns about the vertical far more than it leans: read rightly, the world's up stays put in the body
    while the heading wanders, read wrongly it wanders too. Where nothing wanders, an upside-down vehicle is unlikely.
    """
    columns = np.asarray(values, dtype=np.float64)
    up = {"wxyz": up_in_body(columns), "xyzw": up_in_body(columns[:, [3, 0, 1, 2]])}
    wander = {order: 1.0 - float(np.linalg.norm(mean)) for order, mean in up.items()}
    tilt = {order: float(np.degrees(np.arctan2(np.hypot(m[0], m[1]), m[2]))) for order, m in up.items()}
    orders: tuple[QuaternionOrder, QuaternionOrder] = ("wxyz", "xyzw")
    for order, other in (orders, orders[::-1]):
        # On a straight course it is leaning that wanders, in both readings; but one of them lies on its back.
        if tilt[order] < UPRIGHT_DEG and wander[order] < MAX_WANDER and tilt[other] > UPSIDE_DOWN_DEG:
            # Steep banking and a turning flight with its sensor built in upside down look the same.
            clear = wander[order] < MAX_BANKING or wander[other] > CLEAR_SHARE * wander[order]
            return order if clear else None
    for order, other in (orders, orders[::-1]):
        if wander[other] > MIN_WANDER and wander[order] < CLEAR_SHARE * wander[other]:
            return order
    if max(wander.values()) < 0.5:
        for order, other in (orders, orders[::-1]):
            if tilt[other] > UPSIDE_DOWN_DEG >= tilt[order]:
                return order
    return None
