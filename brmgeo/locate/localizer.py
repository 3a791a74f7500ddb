"""Where an aircraft is, frame by frame: what a program aboard calls, and what a flight folder goes through as well.

What a localizer knows can be saved at any time as one file, from which another process goes on as if nothing had been.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import InputError, SettingsError
from brmgeo.files import digest_of
from brmgeo.flight.camera import slant_gsd_m
from brmgeo.flight.folder import mask_fault
from brmgeo.flight.motion import RESET_SPEED_M_S, MotionSource, Pose
from brmgeo.flight.readings import Attitude, Camera
from brmgeo.flight.values import Estimate, Motion, View
from brmgeo.flight.view import make_view
from brmgeo.locate.maps import Maps
from brmgeo.locate.masks import ROOF_M, above_roofs_m, known_by, network_image, stored_of
from brmgeo.locate.saved import differs, read_saved, settings_of, write_saved
from brmgeo.match import MatchSettings, SmoothedPath, make_matcher
from brmgeo.match.state import under, within
from brmgeo.segment.predict import Answer, Segmenter, picture_of

#: Of the saved file. Raised by hand when what it holds changes.
_FORMAT = 1


def usual_reset_speed_m_s(settings: MatchSettings) -> float:
    """Odometry that moved faster than this was reset: no small aircraft does, unless the settings say that this one can."""
    return max(RESET_SPEED_M_S, settings.odometry.max_speed_m_s)


class LastStep(NamedTuple):
    """What a step was made of: the levelled view, the motion since the one before, and the matcher's seconds."""

    view: View
    motion: Motion
    seconds: float


@dataclass(frozen=True, slots=True)
class _Ways:
    """How a localizer works, beside its maps, camera and network; all of it is saved."""

    method: str
    settings: MatchSettings
    answer: Answer
    roof_m: float | None
    reset_speed_m_s: float
    history: bool


class Localizer:
    """Tells where an aircraft is, from one frame after another.

    Args:
        maps: of the region below.
        camera: the camera of the frames.
        mount: the camera against the body.
        masks: the network that makes masks of pictures; None where masks are handed in.
        method: ``mask``, ``ratio`` or ``paper``.
        settings: of the matcher; None for the defaults.
        answer: what the matcher gets of the network: masks above its threshold, or probabilities.
        roof_m: height above ground, metres, of what masks show as building. None: 3 m for the network's, which finds roofs,
            and 0 for masks that are handed in.
        reset_speed_m_s: odometry that moved faster than this since the frame before was reset. None: 60, or the settings'
            greatest speed where that is higher. ``math.inf`` where the poses' segments tell every reset.
        history: keep every view, so that ``smooth`` can be asked; without it, memory does not grow with the flight.

    Raises SettingsError for another method or a value out of range.
    """

    def __init__(
        self,
        maps: Maps,
        camera: Camera,
        mount: Attitude,
        *,
        masks: Segmenter | None = None,
        method: str = "mask",
        settings: MatchSettings | None = None,
        answer: Answer = "mask",
        roof_m: float | None = None,
        reset_speed_m_s: float | None = None,
        history: bool = False,
    ) -> None:
        settings = settings or MatchSettings()
        if reset_speed_m_s is None:
            reset_speed_m_s = usual_reset_speed_m_s(settings)
        if answer not in ("mask", "probability"):
            raise SettingsError(f"answer {answer!r}: give mask or probability", needs="answer")
        if roof_m is not None and not 0 <= roof_m <= 1000:
            raise SettingsError(f"roofs at {roof_m} m: give 0 to 1000 m above ground", needs="roof_m")
        if not reset_speed_m_s > 0:
            raise SettingsError(
                f"reset speed {reset_speed_m_s} m/s: give one above 0", needs="reset_speed_m_s"
            )
        self.maps, self.camera, self.mount, self.masks = maps, camera, mount, masks
        self._ways = _Ways(method, settings, answer, roof_m, reset_speed_m_s, history)
        self._matcher = make_matcher(method, maps.ground, settings, history=history)
        self._motions = MotionSource(max_speed_m_s=reset_speed_m_s)
        self._t_s = -math.inf
        self._last: LastStep | None = None
        self._maps_known_by: dict[str, Any] | None = None

    @property
    def last(self) -> LastStep | None:
        """What the last step was made of; None before the first one and after loading."""
        return self._last

    def step(
        self,
        t_s: float,
        picture: NDArray[Any],
        attitude: Attitude,
        agl_m: float,
        pose: Pose | None = None,
        *,
        compass_yaw_rad: float | None = None,
        file: str = "",
    ) -> Estimate:
        """Takes in one frame and says where the aircraft is: ``position`` of the answer is None unless that is known.

        Args:
            t_s: time of the frame, seconds; later than the one before.
            picture: (height, width, 3) uint8 RGB, the sensor's rows and columns. In its place a mask of it may stand:
                (height, width) bool, uint8 (0 other, 255 building), or float probability in [0, 1], NaN where unknown.
            attitude: roll and pitch of the body; its yaw is not read.
            agl_m: height above ground, metres.
            pose: the body's pose then, by odometry; None where there is none.
            compass_yaw_rad: yaw of the nose in the map frame from a trusted compass, radians, counter-clockwise from east.
            file: the frame's name, for results.

        A frame that is refused changes nothing: the next one goes on from the one before it. Raises InputError for a time
        that does not increase, a picture that does not fit the camera, or readings that are no numbers; SettingsError for a
        picture where there is no network.
        """
        if not (math.isfinite(t_s) and t_s > self._t_s):
            raise InputError(f"a frame at {t_s} s after one at {self._t_s} s: times must increase")
        read = [] if pose is None else [*pose.xyz_m, *pose.wxyz]
        if not all(map(math.isfinite, [*read, 0.0 if compass_yaw_rad is None else compass_yaw_rad])):
            raise InputError(
                f"a frame at {t_s} s: its pose or compass is no number: hand in None for unknown"
            )
        view = self.view(t_s, picture, attitude, agl_m, file=file)
        motion = self._motions.motion(t_s, pose, compass_yaw_rad)
        self._t_s = t_s
        start = time.perf_counter()
        estimate = self._matcher.step(view, motion)
        self._last = LastStep(view, motion, time.perf_counter() - start)
        return estimate

    def view(
        self, t_s: float, picture: NDArray[Any], attitude: Attitude, agl_m: float, *, file: str = ""
    ) -> View:
        """The levelled view that ``step`` makes of a frame, without taking it in."""
        if not all(map(math.isfinite, (attitude.roll_rad, attitude.pitch_rad, agl_m))) or agl_m <= 0:
            raise InputError(
                f"{file or 'a frame'} at {t_s} s: roll {attitude.roll_rad} rad, pitch {attitude.pitch_rad} rad and height "
                f"{agl_m} m above ground must be numbers, the height above 0"
            )
        size = (self.camera.height, self.camera.width)
        if picture.shape[:2] != size or picture.ndim > 3:
            raise InputError(
                f"{file or 'a frame'} at {t_s} s: an array of {picture.shape}, but the camera's frames are {size}"
            )
        if picture.ndim == 2:
            image, roof_m = _checked_mask(picture, file or "a mask"), 0.0
        else:
            image, roof_m = self._ask(picture, attitude, agl_m, file), ROOF_M
        if self._ways.roof_m is not None:
            roof_m = self._ways.roof_m
        return make_view(
            image,
            self.camera,
            self.mount,
            attitude.roll_rad,
            attitude.pitch_rad,
            above_roofs_m(agl_m, roof_m),
            self.maps.ground.gsd_m,
            t_s=t_s,
            file=file,
        )

    def smooth(self) -> SmoothedPath:
        """The path of all frames so far, also before the first fix; SettingsError without a history."""
        return self._matcher.smooth()

    def _ask(self, picture: NDArray[Any], attitude: Attitude, agl_m: float, file: str) -> NDArray[Any]:
        if self.masks is None:
            raise SettingsError(
                "a picture is handed in, but there is no network to make a mask of it: give a network, or a mask in the "
                "picture's place",
                needs="masks",
            )
        gsd_m = slant_gsd_m(self.camera, self.mount, attitude.roll_rad, attitude.pitch_rad, agl_m)
        probability = self.masks.probability(picture_of(picture, file or "a frame"), gsd_m)
        threshold = self.masks.card.threshold if self._ways.answer == "mask" else None
        return network_image(stored_of(probability), threshold)

    # --- saved and loaded ----------------------------------------------------------------------------------------

    def save(self, path: Path | str) -> None:
        """Writes all that the frames so far have left as one file, whole or not at all, from which ``load`` goes on.

        Raises WorkflowError where the disk does not take it.
        """
        header = {
            "format": _FORMAT,
            "maps": self._maps(),
            "network": _network(self.masks),
            "camera": asdict(self.camera),
            "mount": asdict(self.mount),
            "ways": asdict(self._ways),
        }
        arrays = within("motion", self._motions.state()) | within("matcher", self._matcher.state())
        write_saved(Path(path), header, arrays)

    @classmethod
    def load(cls, path: Path | str, maps: Maps, *, masks: Segmenter | None = None) -> Localizer:
        """The localizer that ``save`` wrote: what it says of the frames that follow is the same, bit for bit.

        Args:
            path: the file.
            maps: those that it was saved over.
            masks: the network that it was saved with; None where it had none.

        Raises MissingInputError where there is no such file; InputError for one that is damaged or cut short, of another
        version of brmgeo, or of other maps or another network.
        """
        header, arrays = read_saved(Path(path), _FORMAT)
        try:
            camera, mount, ways = header["camera"], header["mount"], dict(header["ways"])
            settings = settings_of(ways.pop("settings"))
            camera = Camera(**{**camera, "distortion": tuple(camera["distortion"])})
            here = cls(maps, camera, Attitude(**mount), masks=masks, settings=settings, **ways)
            for name, own in (("maps", here._maps()), ("network", _network(masks))):
                if told := differs(header[name], own):
                    raise InputError(f"{path}: saved with {name} of {told}: give the same, or start anew")
            motion = under(arrays, "motion")
            here._motions.restore(motion)
            here._matcher.restore(under(arrays, "matcher"))
        except InputError as error:
            raise error if str(error).startswith(f"{path}:") else InputError(f"{path}: {error}") from None
        except (SettingsError, LookupError, TypeError, ValueError, AttributeError) as error:
            raise InputError(
                f"{path}: saved by another version of brmgeo, or damaged ({' '.join(str(error).split())[:100]}): start anew"
            ) from None
        here._t_s = float(motion["t_s"]) if "t_s" in motion else -math.inf
        return here

    def _maps(self) -> dict[str, Any]:
        """What the maps are known by."""
        if self._maps_known_by is None:
            ground = self.maps.ground
            self._maps_known_by = {
                "crs": self.maps.crs,
                "shape": list(ground.building.shape),
                "left": ground.left,
                "top": ground.top,
                "gsd_m": ground.gsd_m,
                "content": digest_of(np.ascontiguousarray(ground.building).data),
            }
        return self._maps_known_by


def _network(masks: Segmenter | None) -> dict[str, Any]:
    return dict.fromkeys(("weights", "backend", "looks")) if masks is None else known_by(masks)


def _checked_mask(mask: NDArray[Any], name: str) -> NDArray[Any]:
    if mask.dtype == np.uint8:
        if fault := mask_fault(mask):
            raise InputError(f"{name}: {fault}")
    elif mask.dtype not in (np.bool_, np.float32, np.float64) or ((mask < 0) | (mask > 1)).any():
        raise InputError(
            f"{name}: {mask.dtype} values: give bool, uint8 of 0 and 255, or float probability in [0, 1]"
        )
    return mask
