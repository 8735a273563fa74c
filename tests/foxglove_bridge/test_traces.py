"""A line of the plots is one contact's as long as it lives, whoever comes and goes beside it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from frame_fields import frame_fields
from mcap.reader import make_reader
from tactomo_client import Contact, Frame
from tactomo_client.messages import decode_message, encode_message, frame_from_message
from tactomo_foxglove import write_mcap

PERIOD_NS = 50_000_000


def frame(number: int, ids: Sequence[int], session: str = "a") -> Frame:
    contacts = [Contact(each, 1.0, 2.0, 700.0, 0.1, 0.01, 100.0 + each) for each in ids]
    fields = frame_fields(number, PERIOD_NS * number, contacts, session=session)
    return frame_from_message(decode_message(encode_message("left", "contacts", fields)), None, 0.5)


def traces(path: Path, frames: Sequence[Frame]) -> list[dict[int, int]]:
    """The trace of each contact by its id, frame by frame, as a file for Foxglove has them."""
    with path.open("wb") as file:
        write_mcap([(each.acquired_realtime_ns, each, None) for each in frames], file, "left", {})
    with path.open("rb") as file:
        said = [json.loads(m.data) for _, _, m in make_reader(file).iter_messages(["/left/frame"])]
    return [{each["id"]: each["trace"] for each in one["contacts"]} for one in said]


def test_a_contact_keeps_its_trace_while_others_come_and_go(tmp_path: Path) -> None:
    course = [[1], [1, 2], [1, 2, 3], [2, 3], [2, 3, 4], [3, 4], [], [3], [5, 3], [9]]
    found = traces(tmp_path / "a.mcap", [frame(n, ids) for n, ids in enumerate(course, 1)])
    assert found == [
        *({1: 1}, {1: 1, 2: 2}, {1: 1, 2: 2, 3: 3}, {2: 2, 3: 3}, {2: 2, 3: 3, 4: 1}),
        *({3: 3, 4: 1}, {}, {3: 3}, {3: 3, 5: 1}, {9: 1}),
    ]
