"""Flights in: camera, frames, levelled views, odometry files, and the steps between frames.

``readings`` and ``values`` say what the instruments gave and what the matchers get. ``folder`` and ``odometry`` read
files; ``camera``, ``view`` and ``motion`` compute and know no files. A flight is localized from ``read_flight``, one
``make_view`` a frame, and ``motions``.
"""
