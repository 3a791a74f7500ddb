"""What is seen on roofs is laid onto their outlines on the ground."""

from __future__ import annotations

import math

import cv2
import numpy as np

from brmgeo.flight.camera import pixel_from_point, world_from_camera
from brmgeo.flight.readings import Attitude, Camera
from brmgeo.flight.view import lowered


def test_roofs_are_laid_onto_their_outlines_on_the_ground() -> None:
    camera = Camera(400, 300, 300.0, 300.0, 199.5, 149.5)
    # 20 degrees forward: pixels of one row see the same distance ahead.
    tilt = world_from_camera(Attitude(0.0, math.radians(-20.0), 0.0), 0.0, 0.0, 0.0)
    agl, roof = 60.0, 5.0
    corners = np.array([[10.0, -8.0], [25.0, -8.0], [25.0, 6.0], [10.0, 6.0]])
    at = np.array([0.0, 0.0, agl])

    def drawn(z: float) -> np.ndarray:
        uv = pixel_from_point(camera, tilt, at, np.column_stack([corners, np.full(4, z)]))
        label = np.zeros((300, 400), np.uint8)
        cv2.fillPoly(label, [np.rint(uv * 256).astype(np.int32)], 255, shift=8)
        return label

    moved = lowered(drawn(roof).astype(np.float32), camera, tilt, agl, roof)
    want = drawn(0.0)
    known = np.isfinite(moved)
    assert known.mean() > 0.8
    both, either = ((moved > 127) & (want == 255)).sum(), ((moved > 127) | ((want == 255) & known)).sum()
    assert both / either > 0.97
    roofs = drawn(roof)
    assert ((roofs == 255) & (want == 255)).sum() / ((roofs == 255) | (want == 255)).sum() < 0.9
    # Tilted to the horizon: sky is unknown, and nothing else breaks.
    sky = world_from_camera(Attitude(0.0, math.radians(-85.0), 0.0), 0.0, 0.0, 0.0)
    over = lowered(np.ones((300, 400), np.float32), camera, sky, agl, roof)
    assert np.isnan(over[0]).all()
    assert set(over[np.isfinite(over)]) == {1.0}
