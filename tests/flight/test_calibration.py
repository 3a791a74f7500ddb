"""Calibration files of other tools: the same camera from each, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from brmgeo.errors import FlightError, MissingInputError
from brmgeo.flight.calibration import bend_of, read_calibration

_BEND = (-0.28, 0.074, 0.0002, 0.00002)
_LIST = ", ".join(map(str, _BEND))
_K = "60.1, 0, 39.6, 0, 60.2, 29.4, 0, 0, 1"
_SIZE = "image_width: 80\nimage_height: 60\n"
_KALIBR = f"""cam0:
  T_cam_imu:
  - [1.0, 0.0, 0.0, 0.1]
  - [0.0, 1.0, 0.0, 0.0]
  camera_model: pinhole
  distortion_coeffs: [{_LIST}]
  distortion_model: radtan
  intrinsics: [60.1, 60.2, 39.6, 29.4]
  resolution: [80, 60]
  rostopic: /cam/image_raw
"""
_ROS = f"""{_SIZE}camera_name: narrow
camera_matrix: {{rows: 3, cols: 3, data: [{_K}]}}
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [{_LIST}, 0]
"""
_OPENCV = f"""%YAML:1.0
---
{_SIZE}camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ {_K} ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 4
   dt: d
   data: [ {_LIST} ]
"""
_VINS = f"""%YAML:1.0
---
model_type: PINHOLE
{_SIZE}distortion_parameters:
   k1: -0.28
   k2: 0.074
   p1: 0.0002
   p2: 0.00002
projection_parameters:
   fx: 60.1
   fy: 60.2
   cx: 39.6
   cy: 29.4
"""


@pytest.mark.parametrize("text", [_KALIBR, "---\n" + _KALIBR, _ROS, _OPENCV, _VINS])
def test_every_tool_tells_the_same_camera(tmp_path: Path, text: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    camera = read_calibration(path)
    assert (camera.width, camera.height) == (80, 60)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((60.1, 60.2, 39.6, 29.4))
    assert camera.distortion == pytest.approx((*_BEND, 0.0))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (_KALIBR.replace("radtan", "equidistant"), "'equidistant'"),
        (_ROS.replace("plumb_bob", "equidistant"), "'equidistant'"),
        (_VINS.replace("PINHOLE", "KANNALA_BRANDT"), "'KANNALA_BRANDT'"),
        (_KALIBR + _KALIBR.replace("cam0", "cam1"), "2 cameras"),
        (_ROS.replace("image_width: 80", ""), "image_width has 0 numbers"),
        ("hello", "calibration"),
        ("\t: [[", "calibration"),
    ],
)
def test_other_models_and_files_are_one_line(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(FlightError) as error:
        read_calibration(path)
    assert says in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_coefficients_and_a_missing_file(tmp_path: Path) -> None:
    assert bend_of("", _BEND) == (*_BEND, 0.0)
    assert bend_of("rational_polynomial", (*_BEND, 0.01, 0.0, 0.0, 0.0)) == (*_BEND, 0.01)
    with pytest.raises(FlightError, match="8 distortion coefficients"):
        bend_of("plumb_bob", (*_BEND, 0.01, 0.0, 0.0, 0.5))
    with pytest.raises(MissingInputError, match="missing"):
        read_calibration(tmp_path / "none.yaml")
