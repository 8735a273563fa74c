"""Finds a reconstruction method by its name: ours, an installed one, or `my_module:MyMethod`.

A distribution adds methods by entry points of the group `tactomo.methods`:

    [project.entry-points."tactomo.methods"]
    brightest = "my_module:Brightest"

A module that is named is looked for where Python finds modules, then in the working folder.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Iterable
from functools import cache
from importlib.metadata import entry_points
from typing import Any, Final

from tactomo_models.errors import MethodError, ModelError
from tactomo_models.methods.method import Method
from tactomo_models.sensor.description import SensorDescription

GROUP: Final = "tactomo.methods"
_OURS: Final = {
    "auto": "tactomo_models.methods.auto:Auto",
    "tikhonov": "tactomo_models.methods.linear:Tikhonov",
    "noser": "tactomo_models.methods.linear:Noser",
    "fit": "tactomo_models.methods.fit:Fit",
    "levelset": "tactomo_models.methods.level_set:LevelSetFit",
    "network": "tactomo_models.methods.network:NetworkAlone",
}
METHODS: Final = tuple(_OURS)
"""Those that come with tactomo."""
BUDGETED: Final = ("auto", "fit", "levelset")
"""Those of them that a budget bounds, and that go on in a frame from where the last one ended."""


def available_methods() -> tuple[str, ...]:
    """Names that may be asked for: ours, then those of installed distributions."""
    return METHODS + tuple(sorted(_installed().keys() - _OURS.keys()))


def find_method(name: str) -> Callable[[], Method]:
    """What makes the method of a name, without arguments.

    Raises:
        MethodError: no method has this name, or what has it is no method.
    """
    path = _OURS.get(name) or _installed().get(name, name)
    module_name, colon, attribute = path.partition(":")
    if not (module_name and colon and attribute.isidentifier()):
        raise MethodError(
            f"unknown method {name!r}; use one of: {', '.join(available_methods())}; or one of "
            "your own, as my_module:MyMethod"
        )
    try:
        if path == name:
            search_working_folder()
        module = importlib.import_module(module_name)
    except Exception as error:  # the module is somebody else's: anything may go wrong in it
        raise MethodError(
            f"method {name!r}: cannot import {module_name}: {type(error).__name__}: {error}; run "
            "in its folder, or set PYTHONPATH"
        ) from error
    found: Any = getattr(module, attribute, None)
    if found is None:
        raise MethodError(
            f"method {name!r}: {module.__file__ or module_name} has no {attribute}; check the name"
        )
    if not all(callable(getattr(found, needed, None)) for needed in ("prepare", "solve")):
        raise MethodError(
            f"method {name!r}: {path} is no method: it needs prepare(skin) and "
            "solve(measurement, previous, budget_s), see tactomo_models.methods.method"
        )
    return found  # type: ignore[no-any-return]


def make_method(name: str) -> Method:
    """A new method of a name.

    Raises:
        MethodError: no method has this name, or what has it is no method.
    """
    found = find_method(name)
    try:
        return found()
    except Exception as error:  # somebody else's class
        raise MethodError(
            f"method {name!r} cannot be made: {type(error).__name__}: {error}; a method is made "
            "without arguments"
        ) from error


def search_working_folder() -> None:
    """Let Python find a module that the user has named in the working folder, after all others.

    The `tactomo` script does not look there by itself.
    """
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())


def check_method(name: str, description: SensorDescription) -> None:
    """Make sure that a sensor can be reconstructed that way.

    Raises:
        MethodError: there is no such method, or the sensor lacks a channel that the method needs.
        ArtifactError: the sensor lacks something else, such as a trained network.
    """
    found = find_method(name)
    for channel in getattr(found, "needs", ()):
        if channel not in description.channels:
            raise MethodError(
                f"method {name!r} needs a {channel} channel, and sensor {description.name!r} has "
                "none; use auto, or another method"
            )
    check = getattr(found, "check", None)
    if check is not None:
        check(description)


def left_out(methods: Iterable[str], description: SensorDescription) -> dict[str, ModelError]:
    """Why some of the methods cannot reconstruct a sensor, by their names."""
    why: dict[str, ModelError] = {}
    for name in methods:
        try:
            check_method(name, description)
        except ModelError as error:  # such as a network that nobody trained
            why[name] = error
    return why


@cache
def _installed() -> dict[str, str]:
    return {point.name: point.value for point in entry_points(group=GROUP)}
