"""The errors a user can meet: one root, a handful of kinds.

A message is one line that says what was asked, what was found, where, and what to do. The command line
prints it and leaves with exit status 2; every other exception is a defect of brmgeo and keeps its traceback.
"""

from __future__ import annotations


class BrmgeoError(Exception):
    """Root of all errors that the user's input or machine can cause."""


class SettingsError(BrmgeoError):
    """A region file, flight.toml or command option is malformed or out of range."""


class InputError(BrmgeoError):
    """An input file is unreadable, damaged, empty or not what it was said to be."""


class MissingInputError(InputError):
    """Inputs that the job needs are not there; the message lists which, where they go, where to get them."""


class CrsError(BrmgeoError):
    """Coordinates do not lie where the stated coordinate reference system puts them."""


class WorkflowError(BrmgeoError):
    """The store, the disk, a lock or the scheduler stands in the way."""


class FlightError(InputError):
    """A flight folder breaks the contract of FLIGHT.md; the message names file, line and column."""


class NetworkError(BrmgeoError):
    """A tile service could not be read completely."""
