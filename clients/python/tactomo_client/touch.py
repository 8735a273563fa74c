"""A frame as arrays of fixed shapes, for learning: what a dataset holds and a policy is given.

docs/lerobot.md has the arrays. What is not known is 0 beside a mask that says so, not NaN: one NaN
makes NaN of all statistics that learning scales its inputs by. No value of a known number is
changed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tactomo_client.schema import PRESSURE_RANGES, Contact, Frame, table_row


class Traces:
    """Gives each contact a number, which it keeps: the least, from 1, that no other has.

    A contact's id would not do for a plot or an array, since ids are never used again; nor would
    its place in the list, where others move up when one lifts.
    """

    def __init__(self) -> None:
        self._session = ""
        self._ids: list[int] = []  # of each trace, that of the contact which has it or had it last

    def of(self, frame: Frame) -> list[tuple[Contact, int]]:
        """Return the frame's contacts by their ids, each with its trace."""
        if frame.session != self._session:
            self._session, self._ids = frame.session, []
        contacts = sorted(frame.contacts, key=lambda contact: contact.id)
        shown = {contact.id for contact in contacts}
        for new in sorted(shown - set(self._ids)):
            free = next((i for i, last in enumerate(self._ids) if last not in shown), None)
            if free is None:
                self._ids.append(new)
            else:
                self._ids[free] = new
        return [(contact, self._ids.index(contact.id) + 1) for contact in contacts]


if TYPE_CHECKING:
    from numpy.typing import NDArray

CONTACTS: Final = 16  #: rows for contacts; a hand of five fingers, thrice
CONTACT_COLUMNS: Final = tuple(
    name for name in table_row(Contact(0, 0.0, 0.0, 0.0)) if name != "mount_frame"
)
"""A contact's numbers; `pressure_range` is its place in `frame.PRESSURE_RANGES`."""


def images_of(frame: Frame | None) -> dict[str, NDArray[np.float32] | None]:
    """Return a frame's images by what they show; None for one that it does not have."""
    names = {"pressure_kpa": "pressure_kpa", "magnitude": "map", "structure": "structure"}
    return {name: getattr(frame, of_frame, None) for name, of_frame in names.items()}


class Touch:
    """Turns the frames of one sensor into such arrays, one after the other.

    Args:
        shape: of the maps, (ny, nx).
        contacts: how many rows there are for contacts.

    Example::

        touch = Touch((51, 51))
        for frame in subscribe("left_forearm", latest_only=True):
            action = policy(touch.arrays(frame))
    """

    def __init__(self, shape: tuple[int, int], contacts: int = CONTACTS) -> None:
        self.crowded = 0  #: how many contacts found no row so far
        self._shape = shape
        self._rows = contacts
        self._traces = Traces()

    def arrays(self, frame: Frame | None) -> dict[str, NDArray[Any]]:
        """Return what a frame shows; None: that there is none.

        Raises:
            ValueError: its maps are of another shape.
        """
        table = np.zeros((self._rows, len(CONTACT_COLUMNS)))
        is_number = np.zeros(table.shape, np.uint8)
        for contact, trace in self._traces.of(frame) if frame else ():
            if trace > self._rows:
                self.crowded += 1
                continue
            cells = table_row(contact)
            row = [_number(cells[name]) for name in CONTACT_COLUMNS]
            table[trace - 1] = [0.0 if number is None else number for number in row]
            is_number[trace - 1] = [number is not None for number in row]
        images = {name: self._image(image) for name, image in images_of(frame).items()}
        is_known = frame is not None and frame.is_known
        return {
            **{name: np.nan_to_num(image) for name, image in images.items()},
            "known": (np.isfinite(images["pressure_kpa"]) & is_known).astype(np.uint8),
            "contacts": table,
            "contacts_known": is_number,
            "is_known": np.array([is_known], np.uint8),
            "has_frame": np.array([frame is not None], np.uint8),
        }

    def _image(self, image: NDArray[np.float32] | None) -> NDArray[np.float32]:
        if image is None:
            return np.full(self._shape, np.nan, np.float32)
        if image.shape != self._shape:
            raise ValueError(f"a map is {image.shape}, not {self._shape}: of another sensor")
        return image


def _number(value: float | str | None) -> float | None:
    if isinstance(value, str):
        return float(PRESSURE_RANGES.index(value)) if value in PRESSURE_RANGES else None
    return value
