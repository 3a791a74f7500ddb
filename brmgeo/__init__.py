"""Building ratio map localization: where a drone is, without GNSS, from free building maps."""

__version__ = "0.1.0"
