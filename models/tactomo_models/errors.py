"""What can go wrong in the models, each with its cause and the next step in the message.

ModelError
 ├── DescriptionError   a sensor description that cannot be read or makes no sense
 │                      ("paper.toml: electrodes.length_m = 0.08: must be below the pitch, 0.036")
 ├── ArtifactError      a built artifact that is missing, damaged or made for another sensor
 ├── CalibrationError   load-cell readings that make no curve, or a calibration of another sensor
 ├── DataError          voltages of the wrong shape or kind
 └── MethodError        a reconstruction method that there is not, or that the sensor cannot do
                        ("unknown method 'tikonov'; use one of: auto, tikhonov, ...")
"""

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


class ModelError(Exception):
    """Base of everything that tactomo_models raises on purpose."""


class DescriptionError(ModelError):
    """A sensor description that cannot be read or makes no sense."""


class ArtifactError(ModelError):
    """A built artifact that is missing, damaged or made for another sensor."""


class CalibrationError(ModelError):
    """Load-cell readings that make no curve, or a calibration of another sensor."""


class DataError(ModelError):
    """Voltages of the wrong shape or kind."""


class MethodError(ModelError):
    """A reconstruction method that there is not, or that the sensor cannot do."""


@contextmanager
def os_errors_as(kind: type[ModelError], what: str, next_step: str) -> Iterator[None]:
    """Raise an OSError as one of these; `what` failed, such as "cannot write FILE"."""
    try:
        yield
    except OSError as error:
        raise kind(f"{what}: {error.strerror}; {next_step}") from error


def explain_all(items: Iterable["ErrorDetails"]) -> list[str]:
    """The same of all complaints, but of a list of numbers only the first, and how many follow."""
    of_lists: dict[str, list[ErrorDetails]] = {}
    for item in items:
        key = ".".join(map(str, item["loc"]))
        of_lists.setdefault(re.sub(r"(\.\d+)+$", "", key), []).append(item)
    return [
        explain(first) + (f" (and {len(more)} more of this list)" if more else "")
        for first, *more in of_lists.values()
    ]


def explain(item: "ErrorDetails") -> str:
    """Turn one of pydantic's complaints about a file into "key = value: what is allowed"."""
    key = _short(
        ".".join(str(part) for part in item["loc"] if part not in ("one", "two"))
    )  # no keys
    given = _short(repr(item["input"]))
    message = item["msg"].removeprefix("Value error, ")
    if item["type"] == "extra_forbidden":
        return f"unknown key {key}"
    if item["type"] == "tuple_type":
        return f"{key} = {given}: give a list, in brackets"
    if item["type"] == "finite_number":
        return f"{key} = {given}: give a finite number"
    if item["type"] == "missing":
        return f"{key} is missing"
    if not key:
        return message
    if isinstance(item["input"], dict):  # from a section's own check: its text opens with the key
        return f"{key}.{message}"
    is_beyond = item["type"].startswith(("less_than", "greater_than"))
    if re.search(r"_m(\.\d+)*$", key) and is_beyond:  # in metres
        value = item["input"]
        if abs(value) > 1:
            message += f"; in millimetres? {value:g} mm are {value * 1e-3:g} m"
        elif value > 0:
            message += f"; lengths are metres: {value * 1e6:g} mm are {value * 1e3:g} m"
    return f"{key} = {given}: {message}"


def _short(text: str) -> str:
    """A text, cut where it is longer than a line: anybody may have made the file."""
    most = 100
    return text if len(text) <= most else f"{text[:most]}... ({len(text)} characters)"
