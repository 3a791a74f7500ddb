"""Calibrations of cameras in: YAML of Kalibr and OpenVINS (camchain), OpenCV, ROS (camera_info) and VINS.

All of them count pixels as OpenCV does, whose whole numbers are centres of pixels, so that nothing is shifted.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml  # type: ignore[import-untyped]

from brmgeo.errors import FlightError, MissingInputError
from brmgeo.flight.readings import Camera

_PLAIN = ("radtan", "plumb_bob", "pinhole", "none", "")
Bend = tuple[float, float, float, float, float]


def bend_of(model: str, coefficients: Sequence[float]) -> Bend:
    """k1, k2, p1, p2, k3 of a model by name and 0, 4, 5 or more coefficients, of which those after k3 are zero.

    Raises FlightError, without a file, for fisheye and rational models and other counts.
    """
    values = [float(v) for v in coefficients]
    rational = model in ("rational_polynomial", "thin_prism") and not any(values[5:])
    if model.lower() not in _PLAIN and not rational:
        raise FlightError(
            f"the camera model {model!r} (fisheye or another) is not taken: undistort the pictures, and give the camera of "
            "the undistorted ones"
        )
    if len(values) not in (0, 4, 5, 8, 12, 14) or any(values[5:]) or not np.isfinite(values).all():
        raise FlightError(
            f"{len(values)} distortion coefficients, where k1, k2, p1, p2 and perhaps k3 are taken: undistort the pictures, "
            "or calibrate with these alone"
        )
    k1, k2, p1, p2, k3 = [*values, 0.0, 0.0, 0.0, 0.0, 0.0][:5]
    return k1, k2, p1, p2, k3


def read_calibration(path: Path) -> Camera:
    """The camera of a calibration file.

    Raises MissingInputError where it is not there, FlightError for files that are none of these, several cameras, no size
    of the pictures, and camera models other than a pinhole with k1, k2, p1, p2, k3.
    """
    if not path.is_file():
        raise MissingInputError(f"{path}: the calibration is missing")
    text = path.read_bytes().decode("utf-8-sig", "replace").replace("!!opencv-matrix", "")
    head, _, rest = text.partition("\n")
    try:
        found = yaml.safe_load(rest if head.startswith("%YAML") else text)
        camera = _camera(found if isinstance(found, dict) else {})
    except (yaml.YAMLError, ValueError, RecursionError):
        raise FlightError(f"{path}: no YAML that a calibration tool writes") from None
    except FlightError as error:
        raise FlightError(f"{path}: {error}") from None
    if not np.isfinite([camera.fx, camera.fy, camera.cx, camera.cy]).all() or not (
        camera.fx > 0.0 and camera.fy > 0.0 and camera.width > 0 and camera.height > 0
    ):
        raise FlightError(f"{path}: focal lengths and size of a camera are positive: check the file")
    return camera


def _camera(root: dict[Any, Any]) -> Camera:
    cameras = [
        k for k, v in root.items() if str(k).startswith("cam") and isinstance(v, dict) and "intrinsics" in v
    ]
    if len(cameras) > 1:
        raise FlightError(
            f"{len(cameras)} cameras ({', '.join(cameras)}): keep that of these pictures in the file"
        )
    if cameras:  # Kalibr, OpenVINS
        one = root[cameras[0]]
        kind = str(one.get("camera_model", ""))
        model = str(one.get("distortion_model", "")) if kind == "pinhole" else kind
        width, height = (int(v) for v in _numbers(one, "resolution", 2))
        fx, fy, cx, cy = _numbers(one, "intrinsics", 4)
        return Camera(width, height, fx, fy, cx, cy, bend_of(model, _numbers(one, "distortion_coeffs")))
    width, height = (int(_numbers(root, f"image_{side}", 1)[0]) for side in ("width", "height"))
    plain, bent = root.get("projection_parameters"), root.get("distortion_parameters", {})
    if isinstance(plain, dict) and isinstance(bent, dict):  # VINS
        fx, fy, cx, cy = (_numbers(plain, k, 1)[0] for k in ("fx", "fy", "cx", "cy"))
        bend = [_numbers(bent, k, 1)[0] for k in ("k1", "k2", "p1", "p2") if k in bent]
        return Camera(width, height, fx, fy, cx, cy, bend_of(str(root.get("model_type", "")), bend))
    model = "fisheye" if root.get("fisheye_model") else str(root.get("distortion_model", ""))
    k = _numbers(root, "camera_matrix", 9)
    return Camera(
        width, height, k[0], k[4], k[2], k[5], bend_of(model, _numbers(root, "distortion_coefficients"))
    )


def _numbers(node: dict[Any, Any], key: str, count: int | None = None) -> list[float]:
    # The numbers of a value, a list or a matrix (rows, cols and data).
    value = node.get(key, [])
    value = value.get("data", []) if isinstance(value, dict) else value
    value = value if isinstance(value, list) else [value]
    found = [float(v) for v in value if isinstance(v, (int, float, str))]
    if len(found) != len(value) or (count is not None and len(found) != count):
        raise FlightError(
            f"{key} has {len(found)} numbers, not {count or len(value)}: taken are calibrations of Kalibr, OpenVINS, "
            "OpenCV, ROS and VINS"
        )
    return found
