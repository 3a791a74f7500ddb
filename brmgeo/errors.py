"""The errors a user can meet: one root, a handful of kinds.

A message is one line that says what was asked, what was found, where, and what to do. The command line
prints it and leaves with exit status 2; every other exception is a defect of brmgeo (exit status 70).

The library knows no command line. Where a parameter would mend the fault, ``needs`` names it as the called function does
(such as ``source_crs``), and a command line says which of its options that is.
"""

from __future__ import annotations

from collections.abc import Sequence


def one_line(error: BaseException, most: int = 300) -> str:
    """What an error says, on one line of at most ``most`` characters; its type's name where it says nothing."""
    return " ".join(str(error).split())[:most] or type(error).__name__


class BrmgeoError(Exception):
    """Root of all errors that the user's input or machine can cause.

    Attributes:
        needs: name of the parameter that would mend it, as the called function names it; None where there is none.
    """

    def __init__(self, *args: object, needs: str | None = None) -> None:
        super().__init__(*args)
        self.needs = needs


class SettingsError(BrmgeoError):
    """A region file, flight.toml or a parameter is malformed or out of range."""


class InputError(BrmgeoError):
    """An input file is unreadable, damaged, empty or not what it was said to be."""


class MissingInputError(InputError):
    """Inputs that the job needs are not there; the message lists which, where they go, where to get them."""


class MissingExtraError(BrmgeoError):
    """What was asked for needs libraries that a bare installation leaves out; the message names the extra."""


class CrsError(BrmgeoError):
    """Coordinates do not lie where the stated coordinate reference system puts them."""


class WorkflowError(BrmgeoError):
    """The store, the disk, a lock or the scheduler stands in the way."""


class FlightError(InputError):
    """A flight folder breaks the contract of FLIGHT.md; the message names file, line and column."""


class NetworkError(BrmgeoError):
    """A tile service could not be read completely."""


def listed(names: Sequence[str], most: int = 4) -> str:
    """The first names and how many more there are, for a message."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
