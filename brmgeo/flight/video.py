"""Pictures of a video file by their number, read in order without beginning anew."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import FlightError


class Video:
    """A video file that is opened when a picture of it is asked for, and stays open until ``close``.

    Pictures are counted by decoding, because seeking lands on key frames in many files: in order each is decoded once;
    going back begins at the first.

    ``rate_hz`` is the pictures a second, ``count`` how many the file says it has, ``size`` their (width, height) in pixels.
    """

    def __init__(self, path: Path) -> None:
        """Raises FlightError where the file is not there or is no video; nothing stays open."""
        self.path = path
        self._capture: Any = None
        self._next = 0
        capture = self._opened()
        self.rate_hz = float(capture.get(cv2.CAP_PROP_FPS))
        self.count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.size = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        # What is open stays in its process.
        return self.__dict__ | {"_capture": None, "_next": 0}

    @property
    def is_open(self) -> bool:
        """True while the file is open."""
        return self._capture is not None

    def image(self, number: int) -> NDArray[np.uint8] | None:
        """(h, w, 3) uint8 RGB of the picture of that number, from 0; None where the video has none."""
        if number < self._next:
            self.close()
        capture = self._capture if self.is_open else self._opened()
        ok, image = number >= 0, None
        while ok and self._next <= number:
            ok = capture.grab()
            self._next += 1
        if ok:
            ok, image = capture.retrieve()
        if not ok or image is None:
            return None
        return np.ascontiguousarray(image[:, :, ::-1]).astype(np.uint8, copy=False)

    def close(self) -> None:
        """Lets go of the file; the next picture opens it again."""
        if self._capture is not None:
            self._capture.release()
        self._capture, self._next = None, 0

    def _opened(self) -> Any:
        if not self.path.is_file():
            raise FlightError(f"{self.path}: the video is missing")
        # OpenCV dies of a name that is no UTF-8; this raises.
        self._capture = cv2.VideoCapture(os.fspath(self.path).encode("utf-8").decode())
        if not self._capture.isOpened() or self._capture.get(cv2.CAP_PROP_FPS) <= 0:
            self.close()
            raise FlightError(
                f"{self.path}: no readable video: convert it (for example to H.264 in .mp4) or give pictures"
            )
        return self._capture
