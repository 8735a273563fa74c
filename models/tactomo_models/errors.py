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
from typing import TYPE_CHECKING, Final

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


_NO_KEYS: Final = ("one", "two", "[key]")  # of a place: what a list's length or a name adds
_METRES: Final = re.compile(r"(?<!_s)(?<!_ohm)_m(\.\d+)*$")


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


# What is allowed, by pydantic's kind of error, where pydantic's own words are for programmers.
_ALLOWED: Final = {
    "dict_type": "give a table, [{key}]",
    "model_type": "give a table, [{key}]",
    "tuple_type": "give a list, in brackets",
    "too_short": "give at least {min_length} entries",
    "too_long": "give at most {max_length} entries",
    "string_too_long": "give at most {max_length} characters",
    "string_type": "give a text, in quotes",
    "bool_type": "give true or false",
    "float_type": "give a number",
    "int_type": "give an integer",
    "int_parsing_size": "give a smaller integer",
    "finite_number": "give a finite number",
}


def explain(item: "ErrorDetails") -> str:
    """Turn one of pydantic's complaints about a file into "key = value: what is allowed"."""
    kind, value, limits = item["type"], item["input"], item.get("ctx", {})
    key = _short(".".join(str(part) for part in item["loc"] if part not in _NO_KEYS))
    if kind == "extra_forbidden":
        return f"unknown key {key}"
    if kind == "missing":
        return f"{key} is missing"
    is_beyond = kind.startswith(("less_than", "greater_than"))
    message = (
        _ALLOWED[kind].format(key=key, **limits)
        if kind in _ALLOWED
        else item["msg"]
        .removeprefix("Value error, ")
        .replace("Input should be", "give a number" if is_beyond else "give")
    )
    if not key:
        return message
    if kind == "value_error" and isinstance(value, dict):  # a section's check: opens with the key
        return f"{key}.{message}"
    if item["loc"][-1] == "[key]":  # the name of a table
        return f"{key}: {message}"
    # A length beyond a limit of its own sign is in another unit.
    if is_beyond and _METRES.search(key) and value * next(iter(limits.values())) > 0:
        if abs(value) > 1:
            message += f"; in millimetres? {value:g} mm are {value * 1e-3:g} m"
        else:
            message += f"; lengths are metres: {value * 1e6:g} mm are {value * 1e3:g} m"
    return f"{key} = {_short(repr(value))}: {message}"


def _short(text: str) -> str:
    """A text, cut where it is longer than a line: anybody may have made the file."""
    most = 100
    return text if len(text) <= most else f"{text[:most]}... ({len(text)} characters)"
