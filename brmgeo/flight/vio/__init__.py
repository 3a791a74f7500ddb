"""Visual-inertial odometry over ground: an error-state Kalman filter on tracked points, IMU and height above ground.

The camera looks at a plane whose distance the altimeter gives; that distance is the scale. The filter's state is
attitude, velocity, position, the biases of gyro and accelerometer, the delay between camera and IMU, the camera's
boresight error, and a copy of position and attitude at the last keyframe. Each tracked point ties the present pose to
the keyframe's: its ray from the keyframe meets the plane, and the present camera must see it there.

``Vio`` takes readings and frames as they come and tells the newest pose; ``run_vio`` is a loop over it for a finished
flight. ``kernels`` holds the arithmetic, ``filter`` the state, ``warm`` the start and ``delay`` the clocks.

Sources: error-state filter: Sola, "Quaternion kinematics for the error-state Kalman filter" (2017), in its
global-error form; cloned keyframe: Roumeliotis & Burdick, "Stochastic cloning" (ICRA 2002); delay as a state: Li &
Mourikis, "Online temporal calibration for camera-IMU systems" (IJRR 2014); the plane's homography as measurement:
Bloesch et al., "Fusion of optical flow and inertial measurements for robust egomotion estimation" (IROS 2014).
"""

from __future__ import annotations

from brmgeo.flight.vio.delay import GyroInDegreesError
from brmgeo.flight.vio.filter import VioSettings
from brmgeo.flight.vio.live import Vio, VioStep
from brmgeo.flight.vio.whole import VioResult, run_vio

__all__ = ["GyroInDegreesError", "Vio", "VioResult", "VioSettings", "VioStep", "run_vio"]
