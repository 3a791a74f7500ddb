"""Pictures of a video file by their number, read in order without beginning anew."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import FlightError, InputError
from brmgeo.pictures import decode


class Video:
    """A video file that is opened when a picture of it is asked for, and stays open until ``close``.

    Pictures are counted by decoding, because seeking lands on key frames in many files: in order each is decoded once;
    going back begins at the first. A picture that the decoder finds damaged keeps its number, and so do those that build
    on it, up to the next key frame.

    ``rate_hz`` is the pictures a second, ``count`` how many the file says it has, ``size`` their (width, height) in pixels.
    """

    def __init__(self, path: Path) -> None:
        """Raises FlightError where the file is not there or is no video; nothing stays open."""
        self.path = path
        self._container: Any = None
        self._pictures: Iterator[NDArray[np.uint8] | None] = iter(())
        self._next = 0
        stream = self._opened()
        self.rate_hz = float(stream.average_rate)
        seconds = (stream.container.duration or 0) / 1e6
        self.count = int(stream.frames) or round(seconds * self.rate_hz)
        first = next(self._pictures, None)
        self.size = (stream.width, stream.height) if first is None else (first.shape[1], first.shape[0])
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        # What is open stays in its process.
        return self.__dict__ | {"_container": None, "_pictures": iter(()), "_next": 0}

    @property
    def is_open(self) -> bool:
        """True while the file is open."""
        return self._container is not None

    def image(self, number: int) -> NDArray[np.uint8] | None:
        """(h, w, 3) uint8 RGB of the picture of that number, from 0; None where the video has none.

        Raises FlightError for a picture that is damaged.
        """
        if number < 0:
            return None
        if number < self._next or not self.is_open:
            self.close()
            self._opened()
        for picture in self._pictures:
            self._next += 1
            if self._next > number:
                if picture is None:
                    raise FlightError(
                        f"{self.path}: picture {number} is damaged, or builds on one that is: cut the video there, or "
                        "give pictures"
                    )
                return picture
        self._next = number + 1
        return None

    def close(self) -> None:
        """Lets go of the file; the next picture opens it again."""
        if self._container is not None:
            self._container.close()
        self._container, self._pictures, self._next = None, iter(()), 0

    def _opened(self) -> Any:
        import av

        if not self.path.is_file():
            raise FlightError(f"{self.path}: the video is missing")
        try:
            # Only this file is read: playlists and scripts that name others are no video.
            self._container = av.open(self.path, options={"protocol_whitelist": "file"})
            stream = self._container.streams.video[0]
            # Damage ends a picture instead of being painted over.
            stream.codec_context.options = {"err_detect": "explode"}
            if not stream.average_rate:
                raise ValueError("no rate")
        except (av.error.FFmpegError, IndexError, ValueError, OSError):
            self.close()
            raise FlightError(
                f"{self.path}: no readable video: convert it (for example to H.264 in .mp4) or give pictures"
            ) from None
        self._pictures = _decoded(self._container, stream)
        return stream


def _decoded(container: Any, stream: Any) -> Iterator[NDArray[np.uint8] | None]:
    """All pictures in the order of their times; None for those that are damaged or build on one that is."""
    import av

    waiting: list[int] = []  # times of what was handed to the decoder and has not come out
    sound: dict[int | None, bool] = {}
    whole, painted = True, False
    packets = container.demux(stream)
    while True:
        frames, packet = [], stream
        with _complaints() as heard:
            try:
                packet = next(packets, None)
                if packet is not None:
                    frames = packet.decode()
            except av.error.FFmpegError as error:
                heard.append(str(error))
        if packet is None and not frames:
            break
        if packet is not stream and packet.size:
            whole = (whole or packet.is_keyframe) and not heard
            if stream.codec.name == "mjpeg" and not _is_sound(bytes(packet)):
                whole = False
            sound[packet.pts] = whole
            if packet.pts is not None and not packet.is_discard:
                heapq.heappush(waiting, packet.pts)
        for frame in frames:
            while waiting and frame.pts is not None and waiting[0] < frame.pts:
                heapq.heappop(waiting)
                yield None
            if waiting:
                heapq.heappop(waiting)
            painted = (painted and not frame.key_frame) or frame.is_corrupt
            yield _rgb(frame) if sound.pop(frame.pts, whole) and not painted else None
    for _ in waiting:
        yield None


def _is_sound(jpeg: bytes) -> bool:
    try:
        decode(jpeg, "picture")
    except InputError:
        return False
    return True


@contextmanager
def _complaints() -> Iterator[list[Any]]:
    """What FFmpeg's decoders say of errors meanwhile: they go on after many, and paint over what is missing."""
    from av import logging

    before = logging.get_level()
    logging.set_level(logging.ERROR)
    try:
        with logging.Capture(local=False) as heard:
            yield heard
    finally:
        logging.set_level(before)


def _rgb(frame: Any) -> NDArray[np.uint8]:
    rgb = frame.to_ndarray(format="rgb24", interpolation="BICUBIC")
    return np.ascontiguousarray(np.rot90(rgb, round(frame.rotation / 90.0)))
