"""Levelled views: geometry against direct projection, and features against brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brmgeo.flight.camera import ground_from_pixel, level_from_camera, pixel_from_point
from brmgeo.flight.readings import Attitude, Camera
from brmgeo.flight.values import View
from brmgeo.flight.view import features, make_view

PLAIN = Camera.from_fov(640, 480, 43.0)
BENT = Camera(320, 240, 190.0, 190.0, 158.0, 121.0, (-0.15, 0.03, 0.002, -0.001, 0.0))


def centres(view: View) -> tuple[np.ndarray, np.ndarray]:
    rows, cols = view.building.shape
    ahead = (view.nadir_px[0] - np.arange(rows) - 0.5) * view.gsd_m
    left = (view.nadir_px[1] - np.arange(cols) - 0.5) * view.gsd_m
    return np.meshgrid(ahead, left, indexing="ij")


@pytest.mark.parametrize("camera", [PLAIN, BENT], ids=["pinhole", "distorted"])
def test_a_smooth_picture_of_the_ground_comes_back_at_its_place(camera: Camera) -> None:
    mount, roll, pitch, agl = Attitude(0.03, -0.15, 0.4), -0.06, 0.09, 120.0
    rotation = level_from_camera(mount, roll, pitch)
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))

    def scene(f: np.ndarray, s: np.ndarray) -> np.ndarray:
        return 0.5 + 0.3 * np.sin(f / 29.0) * np.cos(s / 23.0) + 0.002 * f

    ground = ground_from_pixel(camera, rotation, np.array([0.0, 0.0, agl]), np.stack([u, v], -1))
    image = np.nan_to_num(scene(ground[..., 0], ground[..., 1]))
    view = make_view(image, camera, mount, roll, pitch, agl, 0.5)
    f, s = centres(view)
    assert view.known.mean() > 0.5
    assert np.abs(view.building - scene(f, s))[view.known].max() < 0.01
    assert (view.building[~view.known] == 0).all()


def test_known_is_what_the_camera_sees() -> None:
    mount, roll, pitch, agl = Attitude(pitch_rad=-0.2), 0.1, 0.05, 80.0
    view = make_view(np.zeros((240, 320), np.uint8), BENT, mount, roll, pitch, agl, 0.5)
    f, s = centres(view)
    points = np.stack([f, s, np.zeros_like(f)], -1)
    uv = pixel_from_point(BENT, level_from_camera(mount, roll, pitch), np.array([0.0, 0.0, agl]), points)
    inside = (uv > -0.5).all(-1) & (uv < [319.5, 239.5]).all(-1)
    # Only pixels that the frame's edge cuts through may differ.
    assert (inside != view.known).sum() < 2 * sum(view.known.shape)
    assert view.known.any(axis=0)[[1, -2]].all()
    assert view.known.any(axis=1)[[1, -2]].all()


def test_turning_a_camera_in_its_mount_leaves_the_view_as_it_is() -> None:
    camera = Camera.from_fov(401, 401, 50.0)
    rng = np.random.default_rng(3)
    image = (rng.random((401, 401)) < 0.4).astype(np.uint8) * 255
    plain = make_view(image, camera, Attitude(), 0.0, 0.0, 100.0, 0.5)
    # The camera turned left by 90 degrees sees the same ground turned right.
    turned = make_view(
        np.rot90(image, -1).copy(), camera, Attitude(yaw_rad=math.pi / 2), 0.0, 0.0, 100.0, 0.5
    )
    assert np.allclose(plain.building, turned.building, atol=1e-4)
    assert plain.nadir_px == turned.nadir_px


def test_averaging_keeps_the_share_of_building() -> None:
    rng = np.random.default_rng(4)
    image = (rng.random((480, 640)) < 0.3).astype(np.uint8) * 255
    for gsd in (0.2, 0.5, 1.3):
        view = make_view(image, PLAIN, Attitude(), 0.0, 0.0, 150.0, gsd)
        assert view.building[view.known].mean() == pytest.approx(0.3, abs=0.01)
        assert view.building.max() <= 1.0
    fine = make_view(image, PLAIN, Attitude(), 0.0, 0.0, 150.0, 1.0).building.std()
    # Averaged over 16 frame pixels, noise falls to a quarter; a skipped pixel would leave more.
    assert fine == pytest.approx(math.sqrt(0.3 * 0.7) / 4, rel=0.15)


def test_bool_float_and_nan_masks() -> None:
    image = np.zeros((480, 640), bool)
    image[:, :320] = True
    a = make_view(image, PLAIN, Attitude(), 0.0, 0.0, 150.0, 0.5)
    b = make_view(image.astype(np.uint8) * 255, PLAIN, Attitude(), 0.0, 0.0, 150.0, 0.5)
    c = make_view(image.astype(np.float32), PLAIN, Attitude(), 0.0, 0.0, 150.0, 0.5)
    assert np.allclose(a.building, b.building)
    assert np.allclose(a.building, c.building)
    holes = image.astype(np.float32)
    holes[:200] = np.nan
    d = make_view(holes, PLAIN, Attitude(), 0.0, 0.0, 150.0, 0.5)
    assert not d.known[:80].any()
    assert d.known[-80:].sum() == a.known[-80:].sum()
    assert np.isfinite(d.building).all()


def test_oblique_and_far_pixels_are_unknown() -> None:
    mount = Attitude(pitch_rad=math.radians(-60.0))  # the horizon is in the picture
    image = np.full((480, 640), 255, np.uint8)
    view = make_view(image, PLAIN, mount, 0.0, 0.0, 50.0, 0.5, max_off_nadir_deg=70.0, max_stretch=100.0)
    f, s = centres(view)
    reach = np.hypot(f, s)[view.known].max()
    assert reach == pytest.approx(50.0 * math.tan(math.radians(70.0)), rel=0.02)
    near = make_view(image, PLAIN, mount, 0.0, 0.0, 50.0, 0.5, max_radius_m=60.0)
    f, s = centres(near)
    assert np.hypot(f, s)[near.known].max() <= 60.5
    up = make_view(image, PLAIN, Attitude(pitch_rad=-math.pi), 0.0, 0.0, 50.0, 0.5, max_radius_m=30.0)
    assert not up.known.any()


def test_radius_is_half_the_short_sides_ground_width() -> None:
    view = make_view(np.zeros((480, 640), np.uint8), PLAIN, Attitude(), 0.0, 0.0, 150.0, 0.5)
    assert view.radius_m == pytest.approx(150.0 * math.tan(math.radians(21.5)))
    assert view.building.shape == (2 * 119, 2 * 158)


@pytest.mark.parametrize("bad", [0.0, -3.0, math.nan, math.inf])
def test_absurd_heights_and_sizes_are_refused(bad: float) -> None:
    image = np.zeros((480, 640), np.uint8)
    with pytest.raises(ValueError, match="positive"):
        make_view(image, PLAIN, Attitude(), 0.0, 0.0, bad, 0.5)
    with pytest.raises(ValueError, match="does not fit"):
        make_view(image.T, PLAIN, Attitude(), 0.0, 0.0, 100.0, 0.5)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 10**6),
    st.integers(1, 5),
    st.floats(1.0, 14.0),
    st.floats(-3.0, 25.0),
    st.floats(-3.0, 25.0),
)
def test_features_agree_with_brute_force(seed: int, n: int, radius: float, row: float, col: float) -> None:
    rng = np.random.default_rng(seed)
    building = rng.random((20, 23)).astype(np.float32)
    known = rng.random((20, 23)) < 0.7
    building[~known] = 0
    view = View(0.0, building, known, 0.5, (row, col), 100.0, radius * 0.5)
    found = features(view, n)
    for k in range(1, n + 1):
        r = radius * 0.5 * (n + 1 - k) / n / 0.5
        total, count, whole = 0.0, 0, 0
        for i in range(-45, 70):
            for j in range(-45, 70):
                if (i + 0.5 - row) ** 2 + (j + 0.5 - col) ** 2 <= r * r:
                    whole += 1
                    if 0 <= i < 20 and 0 <= j < 23 and known[i, j]:
                        total += float(building[i, j])
                        count += 1
        assert found.radii_m[k - 1] == pytest.approx(r * 0.5)
        if count:
            assert found.f[k - 1] == pytest.approx(total / count, abs=1e-6)
        else:
            assert math.isnan(found.f[k - 1])
        assert found.known_share[k - 1] == pytest.approx(count / whole if whole else 0.0)
