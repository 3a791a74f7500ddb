"""Where an aircraft is, frame by frame: what a program aboard calls, and what a flight folder goes through as well.

What a localizer knows can be saved at any time as one file, from which another process goes on as if nothing had been.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, replace
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
from brmgeo.locate.mount import FoundMount, MountFinder
from brmgeo.locate.saved import differs, read_saved, settings_of, write_saved
from brmgeo.match import Matcher, MatchSettings, SmoothedPath, make_matcher
from brmgeo.match.history import History, motion_of
from brmgeo.match.state import State, under, within
from brmgeo.segment.predict import Answer, Segmenter, picture_of

#: From this on a mount's roll and pitch count as unknown, and are looked for; and the most that may be unknown.
MIN_MOUNT_SIGMA_RAD, MAX_MOUNT_SIGMA_RAD = math.radians(4.0), math.radians(11.0)
#: Another mount than this far off is worth levelling the flight so far anew.
_ANEW_RAD = math.radians(1.0)
#: Frames that wait for the mount, where no history keeps all of them.
_MOST_WAITING = 60
#: Of the saved file. Raised by hand when what it holds changes.
_FORMAT = 2


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
    mount_sigma_rad: float = 0.0


class _Frame(NamedTuple):
    """A frame that waits for its mount to be found: what is seen, and what it was taken with."""

    t_s: float
    image: NDArray[Any]
    attitude: Attitude
    agl_m: float
    motion: Motion
    file: str


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
        mount_sigma_rad: standard deviation of the mount's roll and of its pitch. From ``MIN_MOUNT_SIGMA_RAD`` on they count
            as unknown: no place is surer than they are, until frames enough agree on them (``found_mount``); then the
            flight so far is matched anew.

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
        mount_sigma_rad: float = 0.0,
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
        if not 0 <= mount_sigma_rad <= MAX_MOUNT_SIGMA_RAD:
            raise SettingsError(
                f"mount known to {math.degrees(mount_sigma_rad):g} degrees: give 0 to {math.degrees(MAX_MOUNT_SIGMA_RAD):g}",
                needs="mount_sigma_rad",
            )
        self.maps, self.camera, self.mount, self.masks = maps, camera, mount, masks
        self._told_mount = mount
        self._ways = _Ways(method, settings, answer, roof_m, reset_speed_m_s, history, mount_sigma_rad)
        self.found_mount: FoundMount | None = None
        self._waiting: list[_Frame] = []
        self._finder = None
        if method == "mask" and mount_sigma_rad >= MIN_MOUNT_SIGMA_RAD:
            self._finder = MountFinder(maps.ground, settings, camera, mount, mount_sigma_rad)
        self._matcher = self._fresh(mount_sigma_rad)
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
        self._require_later(t_s)
        read = [] if pose is None else [*pose.xyz_m, *pose.wxyz]
        if not all(map(math.isfinite, [*read, 0.0 if compass_yaw_rad is None else compass_yaw_rad])):
            raise InputError(
                f"a frame at {t_s} s: its pose or compass is no number: hand in None for unknown"
            )
        image, above_m = self._seen(t_s, picture, attitude, agl_m, file)
        motion = self._motions.motion(t_s, pose, compass_yaw_rad)
        return self._take(_Frame(t_s, image, attitude, above_m, motion, file))

    def take(
        self, t_s: float, picture: NDArray[Any], attitude: Attitude, agl_m: float, motion: Motion
    ) -> Estimate:
        """As ``step``, with the motion since the frame before in place of poses."""
        self._require_later(t_s)
        image, above_m = self._seen(t_s, picture, attitude, agl_m, "")
        return self._take(_Frame(t_s, image, attitude, above_m, motion, ""))

    def _require_later(self, t_s: float) -> None:
        if not (math.isfinite(t_s) and t_s > self._t_s):
            raise InputError(f"a frame at {t_s} s after one at {self._t_s} s: times must increase")

    def _take(self, frame: _Frame) -> Estimate:
        self._t_s = frame.t_s
        start = time.perf_counter()
        view = self._levelled(frame, self.mount)
        estimate = self._matcher.step(view, frame.motion)
        if self._finder is not None:
            estimate = self._seek(self._finder, frame, estimate)
        self._last = LastStep(view, frame.motion, time.perf_counter() - start)
        return estimate

    def _seek(self, finder: MountFinder, frame: _Frame, estimate: Estimate) -> Estimate:
        """The estimate, once the mount is found by this frame that of the flight so far, matched anew."""
        self._waiting.append(frame)
        if not self._ways.history:
            del self._waiting[:-_MOST_WAITING]
        if estimate.mass <= self._ways.settings.belief.converged_mass or not math.isfinite(estimate.yaw_rad):
            return estimate
        sigma_m = math.sqrt(float(np.trace(estimate.covariance)) / 2.0)
        pose = np.array([*estimate.mean, estimate.yaw_rad])
        finder.add(
            lambda mount: self._levelled(frame, mount),
            frame.attitude,
            frame.agl_m,
            pose,
            sigma_m,
            self.mount,
        )
        found, agreed = finder.found()
        if found is None:
            return estimate
        waiting = self._waiting
        if agreed:
            self._adopt(found)
        elif _apart_rad(found.mount, self.mount) > _ANEW_RAD:
            # Better than what was told, but not agreed on: views are levelled by it, and no place is surer for it.
            self.mount, self._matcher = found.mount, self._fresh(self._ways.mount_sigma_rad)
        else:
            return estimate
        for earlier in waiting:
            estimate = self._matcher.step(self._levelled(earlier, self.mount), earlier.motion)
        return estimate

    def _adopt(self, found: FoundMount) -> None:
        self.found_mount, self.mount = found, found.mount
        self._finder, self._waiting = None, []
        self._matcher = self._fresh(found.sigma_rad)

    def _fresh(self, mount_sigma_rad: float) -> Matcher:
        """A matcher that has seen nothing, of views that are levelled as well as the mount is known."""
        ways, odometry = self._ways, self._ways.settings.odometry
        if self._finder is None:
            sigma = math.hypot(odometry.mount_sigma_rad, mount_sigma_rad)
            odometry = replace(odometry, mount_sigma_rad=sigma)
        else:
            # A mount that is far off is no constant: turns and heights make another error of it in each frame.
            sigma = math.hypot(odometry.attitude_sigma_rad, mount_sigma_rad)
            odometry = replace(odometry, attitude_sigma_rad=sigma)
        settings = ways.settings if mount_sigma_rad == 0 else replace(ways.settings, odometry=odometry)
        return make_matcher(ways.method, self.maps.ground, settings, history=ways.history)

    def view(
        self, t_s: float, picture: NDArray[Any], attitude: Attitude, agl_m: float, *, file: str = ""
    ) -> View:
        """The levelled view that ``step`` makes of a frame, without taking it in."""
        image, above_m = self._seen(t_s, picture, attitude, agl_m, file)
        still = Motion(dt_s=0.0, step_m=None, yaw_rad=None)
        return self._levelled(_Frame(t_s, image, attitude, above_m, still, file), self.mount)

    def _seen(
        self, t_s: float, picture: NDArray[Any], attitude: Attitude, agl_m: float, file: str
    ) -> tuple[NDArray[Any], float]:
        """The mask of a frame, and the height above what it shows, metres."""
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
        return image, above_roofs_m(agl_m, roof_m)

    def _levelled(self, frame: _Frame, mount: Attitude) -> View:
        return make_view(
            frame.image,
            self.camera,
            mount,
            frame.attitude.roll_rad,
            frame.attitude.pitch_rad,
            frame.agl_m,
            self.maps.ground.gsd_m,
            t_s=frame.t_s,
            file=frame.file,
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
            "told_mount": asdict(self._told_mount),
            "ways": asdict(self._ways),
            "found_mount": None if self.found_mount is None else self.found_mount.sigma_rad,
            "files": [frame.file for frame in self._waiting],
        }
        arrays = within("motion", self._motions.state()) | within("matcher", self._matcher.state())
        if self._finder is not None:
            arrays |= within("waiting", _waiting_state(self._waiting, self._finder))
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
            as_told = Attitude(**header["told_mount"])
            here = cls(maps, camera, as_told, masks=masks, settings=settings, **ways)
            here.mount = Attitude(**mount)
            for name, own in (("maps", here._maps()), ("network", _network(masks))):
                if told := differs(header[name], own):
                    raise InputError(f"{path}: saved with {name} of {told}: give the same, or start anew")
            if (sigma_rad := header["found_mount"]) is not None:
                here._adopt(FoundMount(here.mount, sigma_rad))
            elif here._finder is not None:
                waiting = under(arrays, "waiting")
                here._waiting = _waiting_of(waiting, header["files"])
                here._finder.said = [tuple(row) for row in waiting["said"].tolist()]
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


def _apart_rad(one: Attitude, other: Attitude) -> float:
    return math.hypot(one.roll_rad - other.roll_rad, one.pitch_rad - other.pitch_rad)


def _waiting_state(waiting: list[_Frame], finder: MountFinder) -> State:
    """Frames that wait for the mount, and what frames said of it, as named arrays."""
    kept = History()
    for frame in waiting:
        kept.add(frame.t_s, frame.motion)
    taken = [(frame.t_s, frame.attitude.roll_rad, frame.attitude.pitch_rad, frame.agl_m) for frame in waiting]
    return {
        "images": np.array([frame.image for frame in waiting]),
        "taken": np.array(taken, np.float64).reshape(-1, 4),
        "motion": kept.state()["motion"],
        "said": np.array(finder.said, np.float64).reshape(-1, 4),
    }


def _waiting_of(state: State, names: list[str]) -> list[_Frame]:
    """The frames of ``_waiting_state``."""
    return [
        _Frame(float(t_s), image, Attitude(float(roll), float(pitch)), float(agl_m), motion_of(row), name)
        for image, (t_s, roll, pitch, agl_m), row, name in zip(
            state["images"], state["taken"], state["motion"], names, strict=True
        )
    ]


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
