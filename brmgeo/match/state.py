"""A matcher's state as named arrays: what a program aboard saves, so that another process goes on from there.

Names are flat (``belief.blocks``); numbers and words are arrays without dimensions and there are no Python objects, so
``numpy.savez`` keeps a state and ``numpy.load`` gives it back without pickle. What the state must agree in with the
matcher that takes it up is part of it: method, ground and settings.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import InputError
from brmgeo.files import json_of
from brmgeo.match.ground import GroundMap
from brmgeo.match.settings import MatchSettings

State = dict[str, NDArray[Any]]


def signature(method: str, ground: GroundMap, settings: MatchSettings) -> State:
    """What a state is of: the method, the ground's place and size, and all settings."""
    place = [*map(float, ground.building.shape), ground.left, ground.top, ground.gsd_m]
    return {
        "method": np.array(method),
        "ground": np.array(place, np.float64),
        "settings": np.array(json.dumps(asdict(settings), sort_keys=True)),
    }


def within(name: str, state: Mapping[str, NDArray[Any]]) -> State:
    """The state with ``name.`` before each name."""
    return {f"{name}.{key}": value for key, value in state.items()}


def under(state: Mapping[str, NDArray[Any]], name: str) -> State:
    """What ``within`` put under ``name``, as copies."""
    start = f"{name}."
    return {k.removeprefix(start): np.array(v) for k, v in state.items() if k.startswith(start)}


def check_state(state: Mapping[str, NDArray[Any]], own: State) -> None:
    """Raises InputError unless ``state`` is of the matcher whose state at the start is ``own``.

    Method, ground and settings must be equal, and so must names, dtypes and shapes, but for the length of what is empty
    at the start.
    """
    for name in ("method", "ground", "settings"):
        if name in state and not np.array_equal(state[name], own[name]):
            raise InputError(
                f"the saved state is of another {name}: {_first_difference(state[name], own[name])}; "
                f"make the matcher of the same {name}"
            )
    if odd := sorted(set(state) ^ set(own)):
        raise InputError(
            f"the saved state and the matcher differ in {', '.join(odd)}; "
            "make the matcher with the same history, or start anew"
        )
    for name, value in own.items():
        given = state[name]
        words = value.dtype.kind == "U" and given.dtype.kind == "U"
        first = 1 if value.ndim and value.shape[0] == 0 else 0
        shaped = given.ndim == value.ndim and given.shape[first:] == value.shape[first:]
        if not shaped or not (words or given.dtype == value.dtype):
            raise damaged(f"{name} is {given.dtype} {given.shape}, not {value.dtype} {value.shape}")


def damaged(what: str) -> InputError:
    """The error of a state whose arrays contradict each other."""
    return InputError(f"the saved state is damaged: {what}; start anew")


def _first_difference(given: NDArray[Any], own: NDArray[Any]) -> str:
    if own.ndim or own.dtype.kind != "U" or not str(own).startswith("{"):
        return f"{given.tolist()} there, {own.tolist()} here"
    try:
        there, here = json_of(str(given)), json_of(str(own))
        for group, values in here.items():
            for name, value in values.items():
                if there[group][name] != value:
                    return f"{group}.{name} is {there[group][name]} there, {value} here"
    except (ValueError, LookupError, TypeError):
        pass
    return "other names"
