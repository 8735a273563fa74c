"""Stream and control messages: they round-trip, and no bytes at all break the decoder."""

from __future__ import annotations

from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
import pytest
from fuzz_targets import ENVELOPE as HEADER
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from tactomo_client.errors import MessageError
from tactomo_client.filled import ARRAY_DTYPES, MAX_ARRAY_VALUES
from tactomo_client.messages import (
    KINDS,
    array_from_wire,
    array_to_wire,
    decode_message,
    decode_reply,
    decode_request,
    encode_message,
    encode_reply,
    encode_request,
    topic,
)

RESERVED = {"schema", "sensor", "kind", "clock_id", *HEADER}
OPTIONAL = {"delay_ns", "dated_by", "skew_ms", "confidence"}  # header fields of types of their own

scalars = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text()
values = st.recursive(
    scalars | st.binary(max_size=64),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


def arrays() -> st.SearchStrategy[np.ndarray[Any, Any]]:
    return st.sampled_from(ARRAY_DTYPES).flatmap(
        lambda name: hnp.arrays(
            np.dtype(name), hnp.array_shapes(min_dims=1, max_dims=4, min_side=0, max_side=5)
        )
    )


@pytest.mark.slow
@given(
    sensor=st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", fullmatch=True),
    kind=st.sampled_from(KINDS),
    extra=st.dictionaries(
        st.text().filter(lambda k: k not in RESERVED | OPTIONAL),
        values.filter(lambda v: v == v),
        max_size=4,
    ),
)
def test_any_message_round_trips(sensor: str, kind: str, extra: dict[str, Any]) -> None:
    header = {name: value for name, value in HEADER.items() if name != "clock_id"}
    data = encode_message(
        sensor, kind, header | {k: v for k, v in extra.items() if k != "clock_id"}
    )
    assert data.startswith(topic(sensor, kind))
    message = decode_message(data)
    assert (message.sensor, message.kind) == (sensor, kind)
    for name, value in HEADER.items():
        assert message.fields[name] == value
    assert message.fields.keys() == RESERVED - {"clock_id"} | extra.keys()


@given(arrays())
def test_any_array_round_trips(array: np.ndarray[Any, Any]) -> None:
    wire = msgpack.unpackb(msgpack.packb(array_to_wire(array)))
    back = array_from_wire(wire)
    assert back.dtype == array.dtype
    assert back.shape == array.shape
    assert back.tobytes() == array.tobytes()
    assert not back.flags.writeable


def test_big_endian_and_strided_arrays_keep_their_values() -> None:
    array = np.arange(12, dtype=">f4").reshape(3, 4)[:, ::2]
    np.testing.assert_array_equal(array_from_wire(array_to_wire(array)), array)
    assert array_to_wire(array)["dtype"] == "<f4"


@given(
    shape=scalars | st.lists(scalars | st.integers(-1, 2**63), max_size=6),
    dtype=scalars | st.sampled_from([*ARRAY_DTYPES, ">f4", "O", "|V8", "f4,f4", "<M8[s]"]),
    data=scalars | st.binary(max_size=64),
)
def test_no_array_map_breaks_the_decoder(shape: object, dtype: object, data: object) -> None:
    try:
        array = array_from_wire({"shape": shape, "dtype": dtype, "data": data})
    except MessageError:
        return
    assert list(array.shape) == shape
    assert array.tobytes() == data


@pytest.mark.parametrize(
    "wire",
    [
        {"shape": [2**40], "dtype": "<f4", "data": b""},
        {"shape": [MAX_ARRAY_VALUES, MAX_ARRAY_VALUES, 0], "dtype": "<f4", "data": b"\0"},
        {"shape": [2, MAX_ARRAY_VALUES], "dtype": "|u1", "data": bytes(2 * MAX_ARRAY_VALUES)},
        {"shape": [-1], "dtype": "|u1", "data": b"\0"},
        {"shape": [2], "dtype": "<f4", "data": b"\0" * 7},
        {"shape": [1], "dtype": "O", "data": b"\0" * 8},
        None,
    ],
)
def test_a_bad_array_is_named(wire: object) -> None:
    with pytest.raises(MessageError):
        array_from_wire(wire)


@pytest.mark.parametrize(
    ("change", "mentions"),
    [
        ({"sequence": -1}, "sequence"),
        ({"sequence": True}, "sequence"),
        ({"session": None}, "session"),
        ({"flags": [1]}, "flags"),
        ({"flags": "misfit_high"}, "flags"),
        ({"misfit": "1"}, "misfit"),
    ],
)
def test_a_bad_header_is_refused_on_both_sides(change: dict[str, Any], mentions: str) -> None:
    with pytest.raises(MessageError, match=mentions):
        encode_message("left", "map", HEADER | change)
    body = {"schema": 1, "sensor": "left", "kind": "map"} | HEADER | change
    with pytest.raises(MessageError, match=mentions):
        decode_message(b"left/map\0" + msgpack.packb(body))


def test_another_schema_says_what_to_do() -> None:
    body = msgpack.packb({"schema": 2, "sensor": "left", "kind": "map"} | HEADER)
    with pytest.raises(MessageError, match=r"schema 2 is not 1.*install"):
        decode_message(b"left/map\0" + body)


def test_topic_and_body_must_agree() -> None:
    body = encode_message("left", "map", HEADER).partition(b"\0")[2]
    with pytest.raises(MessageError, match="disagree"):
        decode_message(b"right/map\0" + body)


@pytest.mark.parametrize("sensor", ["le ft", "", "a/b", "a\0", "ä", "a" * 65, ".hidden"])
def test_names_that_cannot_be_topics_are_refused(sensor: str) -> None:
    with pytest.raises(MessageError, match="sensor name"):
        topic(sensor, "map")
    body = msgpack.packb({"schema": 1, "sensor": sensor, "kind": "map"} | HEADER)
    with pytest.raises(MessageError):
        decode_message(f"{sensor}/map".encode() + b"\0" + body)


@given(command=st.text(), arguments=st.dictionaries(st.text(), scalars.filter(lambda v: v == v)))
def test_any_request_round_trips(command: str, arguments: dict[str, Any]) -> None:
    try:
        data = encode_request(command, arguments)
    except MessageError:  # lone surrogates have no UTF-8
        return
    assert decode_request(data) == (command, arguments)


@pytest.mark.parametrize(
    "pairs",
    [
        [("command", "status"), ("command", "tare")],
        [("command", "press"), ("arguments", [("x_mm", 1.0), ("x_mm", 2.0)])],
    ],
)
def test_a_request_in_which_a_key_comes_twice_is_none(pairs: list[tuple[str, Any]]) -> None:
    packer = msgpack.Packer(autoreset=False)

    def pack(value: object) -> None:
        if isinstance(value, list):
            packer.pack_map_header(len(value))
            for key, inside in value:
                packer.pack(key)
                pack(inside)
        else:
            packer.pack(value)

    pack([("schema", 1), *pairs])
    with pytest.raises(MessageError, match="a key comes twice"):
        decode_request(packer.bytes())


def test_a_name_that_is_no_text_holds_back_no_message() -> None:
    """A port, a folder or a file may have any bytes in its name; a command's may not."""
    name = b"/dev/\xe9".decode("utf-8", "surrogateescape")
    sent = decode_message(encode_message("left", "event", {**HEADER, "detail": name}))
    assert sent.fields["detail"] == "/dev/?"
    assert decode_reply(encode_reply({"path": name})) == {"path": "/dev/?"}
    with pytest.raises(MessageError):
        encode_request("record_start", {"path": name})
