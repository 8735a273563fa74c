"""Times that callers give, checked where they are given: later nobody knows where one came from."""

from __future__ import annotations

import math
from numbers import Real


def checked_seconds(
    name: str, value: object, *, endless: bool = True, zero: bool = True, past: bool = False
) -> float:
    """Return a time in seconds as a float.

    Args:
        name: of the argument, for the error.
        value: what was given for it.
        endless: whether infinity makes sense.
        zero: whether 0 does.
        past: whether less does: what is left of a time that is over.

    Raises:
        TypeError: it is no number.
        ValueError: it is NaN, or makes no sense.
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError(f"{name} = {value!r} is no number: give seconds, such as 0.5")
    try:
        seconds = float(value)
    except OverflowError:
        seconds = -math.inf if value < 0 else math.inf
    is_in_range = past or seconds > 0 or (zero and seconds == 0)
    if is_in_range and not math.isnan(seconds) and (endless or math.isfinite(seconds)):
        return seconds
    allowed = "any but NaN" if past else "0 or more" if zero else "more than 0"
    raise ValueError(f"{name} = {value!r}: give {'' if endless else 'finite '}seconds, {allowed}")
