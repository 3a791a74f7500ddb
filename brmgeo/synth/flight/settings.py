"""How a simulated aircraft flies, what its instruments are worth, and what its network does wrong."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Annotated

from pydantic import Field

from brmgeo.flight.readings import Attitude, Camera
from brmgeo.region import Share
from brmgeo.settings import checked

# Least and most of the numbers, held where a file of settings is read, and where a flight begins.
NotNegative = Annotated[float, Field(ge=0.0, le=1e6)]
Length = Annotated[float, Field(ge=0.1, le=1000.0)]


@dataclass(frozen=True, slots=True)
class MaskErrors:
    """What a segmentation network does wrong.

    Attributes:
        missed: share of buildings missing from a frame's mask.
        missed_always: how much of that is the building's own doing: 0 misses at random in each frame, 1 misses
            the same buildings in every frame (correlation of a latent Gaussian).
        false_blobs: mean number of false buildings in a frame.
        blob_radius_m: their median radius; it varies by half.
        edge_sigma_m: standard deviation of edges about the truth, per axis.
        edge_scale_m: length over which an edge's error changes.
        pixel_accuracy: when given, pixels are flipped in smooth patches, after the errors above, until this share
            of all pixels is as it was; 0.916 is the accuracy of the paper's network.
    """

    missed: Share = 0.12
    missed_always: Share = 0.5
    false_blobs: Annotated[float, Field(ge=0.0, le=1000.0)] = 3.0
    blob_radius_m: Length = 4.0
    edge_sigma_m: NotNegative = 0.5
    edge_scale_m: Length = 3.0
    pixel_accuracy: Annotated[float, Field(ge=0.5, le=1.0)] | None = None

    @classmethod
    def none(cls) -> MaskErrors:
        """A perfect network."""
        return cls(missed=0.0, false_blobs=0.0, edge_sigma_m=0.0)

    @classmethod
    def degraded(cls, pixel_accuracy: float = 0.916) -> MaskErrors:
        """Only pixel errors, to a given accuracy."""
        return cls(missed=0.0, false_blobs=0.0, edge_sigma_m=0.0, pixel_accuracy=pixel_accuracy)


@dataclass(frozen=True, slots=True)
class OdometryErrors:
    """Errors of monocular visual-inertial odometry.

    Attributes:
        scale_sigma: standard deviation of the scale bias when ``scale_bias`` is None.
        scale_bias: the bias itself: 0.05 makes every step 5 % too long.
        drift_deg_sqrt_min: heading random walk, degrees per root minute.
        noise_m_sqrt_s: position random walk per axis, metres per root second.
        states_noise: the odometry says itself what its steps are worth: ``noise_m_sqrt_s``, as a covariance.
        reset_times_s: at each of these times the filter starts again: two seconds of silence, then a new origin and yaw.
        rate_hz: poses a second.
    """

    scale_sigma: NotNegative = 0.05
    scale_bias: Annotated[float, Field(ge=-0.9, le=10.0)] | None = None
    drift_deg_sqrt_min: NotNegative = 0.75
    noise_m_sqrt_s: NotNegative = 0.05
    states_noise: bool = False
    reset_times_s: tuple[NotNegative, ...] = ()
    rate_hz: Annotated[float, Field(ge=0.5, le=100.0)] = 10.0

    @classmethod
    def none(cls) -> OdometryErrors:
        """Perfect odometry (in a frame of arbitrary origin and yaw all the same)."""
        return cls(scale_sigma=0.0, scale_bias=0.0, drift_deg_sqrt_min=0.0, noise_m_sqrt_s=0.0)


@dataclass(frozen=True, slots=True)
class SimulationSettings:
    """How the simulated aircraft flies and what its instruments are worth.

    Attributes:
        camera, mount: the camera and how it sits in the body.
        told_mount: how the flight says that the camera sits; None for as it does.
        speed_m_s, frame_interval_s, agl_m: cruise.
        agl_sigma_m: slow changes of height about ``agl_m``.
        wobble_deg: standard deviation of roll and pitch about the flight's own.
        cruise_pitch_deg: nose-down attitude of a multirotor at cruise.
        crab_sigma_deg: angle between nose and course, one draw a flight.
        turn_radius_m: rounding of the path's corners.
        attitude_error_deg: error of the measured roll and pitch: one draw a flight and as much again each frame.
        agl_error_m: error of the measured height: one draw a flight and as much again each frame.
        compass_error_deg: error of the compass, one draw a flight and as much again each frame; None for no compass.
        masks, odometry: their error models; odometry None flies without.
        exposure_s: shutter time, for motion blur.
        exposure_sigma: standard deviation of the picture's brightness from frame to frame, as a factor.
        noise_levels: standard deviation of sensor noise at middle grey, of 255.
        vignette: share of light lost in the corners.
        jpeg_quality: of the written frames.
        sun_azimuth_deg: where the light on the walls comes from, clockwise from north.
    """

    camera: Camera = field(default_factory=lambda: Camera.from_fov(640, 480, 43.0))
    mount: Attitude = field(default_factory=Attitude)
    told_mount: Attitude | None = None
    speed_m_s: Annotated[float, Field(ge=0.1, le=200.0)] = 5.0
    frame_interval_s: Annotated[float, Field(ge=0.02, le=60.0)] = 5.0
    agl_m: Annotated[float, Field(ge=5.0, le=5000.0)] = 150.0
    agl_sigma_m: NotNegative = 2.0
    wobble_deg: NotNegative = 1.5
    cruise_pitch_deg: Annotated[float, Field(ge=-45.0, le=45.0)] = 2.0
    crab_sigma_deg: NotNegative = 3.0
    turn_radius_m: Length = 8.0
    attitude_error_deg: NotNegative = 0.2
    agl_error_m: NotNegative = 0.4
    compass_error_deg: NotNegative | None = None
    masks: MaskErrors = field(default_factory=MaskErrors)
    odometry: OdometryErrors | None = field(default_factory=OdometryErrors)
    exposure_s: NotNegative = 1.0 / 250.0
    exposure_sigma: NotNegative = 0.05
    noise_levels: NotNegative = 3.0
    vignette: Share = 0.15
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = 92
    sun_azimuth_deg: Annotated[float, Field(ge=-360.0, le=360.0)] = 152.0

    @property
    def known_mount(self) -> Attitude:
        """The mount that whoever locates the flight goes by."""
        return self.mount if self.told_mount is None else self.told_mount


def require_possible(settings: SimulationSettings) -> None:
    """Raises SettingsError for a value out of range, from wherever it came."""
    checked(SimulationSettings, asdict(settings), "the simulated flight")
