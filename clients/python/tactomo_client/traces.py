"""Which row, line or slot a contact has for as long as it lives."""

from __future__ import annotations

from tactomo_client.schema import Contact, Frame


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
