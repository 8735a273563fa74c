"""Whatever bytes come, a parser says what it documents and nothing else; `make fuzz` goes on."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
import pytest
from fuzz_targets import HEADER, TANK, TARGETS, import_anything
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from tactomo_client import MessageError
from tactomo_client.messages import MAX_DEPTH, MAX_ENTRIES, decode_message, encode_message
from tactomo_models import load_description
from tactomo_models.errors import DescriptionError
from tactomo_models.sensor.description_file import shipped_text

POSITION = st.integers(0, 2**16)


@st.composite
def mutations(draw: st.DrawFn, examples: list[bytes]) -> bytes:
    """Valid input, then flipped, cut, repeated, and joined with another at any place."""
    data = bytearray(draw(st.sampled_from(examples)))
    for _ in range(draw(st.integers(0, 6))):
        at = draw(POSITION) % (len(data) + 1)
        match draw(st.sampled_from(["flip", "set", "cut", "insert", "splice", "repeat"])):
            case "flip" if at < len(data):
                data[at] ^= 1 << draw(st.integers(0, 7))
            case "set" if at < len(data):
                data[at] = draw(st.sampled_from([0, 1, 0x7F, 0x80, 0xC1, 0xDD, 0xDF, 0xFF]))
            case "cut":
                del data[at : at + draw(st.integers(1, 64))]
            case "insert":
                data[at:at] = draw(st.binary(max_size=16))
            case "splice":
                other = draw(st.sampled_from(examples))
                data[at:] = other[draw(POSITION) % (len(other) + 1) :]
            case "repeat":
                data[at:at] = data[at : at + 32] * draw(st.integers(1, 8))
    return bytes(data)


@pytest.mark.parametrize("name", TARGETS)
def test_what_is_valid_is_taken(name: str) -> None:
    examples = TARGETS[name].examples()
    assert examples
    for example in examples:
        assert TARGETS[name].parse(example)


@pytest.mark.hypothesis
@pytest.mark.parametrize("name", TARGETS)
def test_no_mutation_breaks_a_parser(name: str) -> None:
    target = TARGETS[name]
    examples = target.examples()

    @given(data=st.one_of(mutations(examples), st.binary(max_size=200)))
    def try_it(data: bytes) -> None:
        target.parse(data)

    try_it()


@st.composite
def archives(draw: st.DrawFn) -> dict[str, NDArray[Any]]:
    """Arrays of both layouts that can be imported, and what becomes of them in other hands."""
    count = TANK.electrode_count
    volts = np.sin(np.arange(3.0 * count**2)).reshape(3, count, count)
    pairs = np.array([(k, (k + 1) % count) for k in range(count)], float)
    structure = volts.reshape(3, -1)[:, : TANK.measurements]
    scans = {"structure": structure, "structure_reference": structure[0]}
    scans["magnitude"] = structure * np.nan
    single = {"volts": volts, "injection": pairs}
    arrays = {**draw(st.sampled_from([scans, single])), "t": np.arange(3.0)}
    for name in draw(st.sets(st.sampled_from(sorted(arrays)), max_size=2)):
        array = arrays[name].copy()
        at = draw(POSITION) % array.size
        array.flat[at] = draw(st.sampled_from([np.nan, np.inf, -1e300, 1e18, 0.0, -1.0]))
        cut = draw(st.sampled_from([slice(None), slice(None), slice(0, 0), slice(1, None), None]))
        kind = draw(st.sampled_from(["f8", "f8", "f4", "c16", "i8", "u4", "?", "U4", "M8[s]"]))
        arrays[name] = array[cut].astype(kind)
    return arrays


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@given(arrays=archives())
def test_any_arrays_are_scans_or_refused(
    tmp_path_factory: pytest.TempPathFactory, arrays: dict[str, NDArray[Any]]
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.npz"
    np.savez(path, **arrays)  # type: ignore[arg-type]
    import_anything(path)


def hostile_bodies() -> dict[str, bytes]:
    def of(value: Any) -> bytes:
        fields = {"schema": 1, "sensor": "left", "kind": "map", **HEADER, "extra": value}
        return bytes(msgpack.packb(fields))

    deep: Any = []
    for _ in range(300):
        deep = [deep]
    huge_list, huge_map = b"\xdd\x00\xff\xff\xff", b"\xdf\x00\xff\xff\xff"
    return {
        "deep": of(deep),
        "deeper": b"\x91" * 100_000,
        "deep maps": b"\x81\xa1a" * 30_000,
        "a list that claims 16 million": huge_list + b"\xc0" * 100,
        "such lists in each other": huge_list * 1000 + b"\xc0" * 100,
        "such maps in each other": (huge_map + b"\xa1a") * 1000,
        "more entries than allowed": of([0] * (MAX_ENTRIES + 1)),
        "a binary that claims 4 GB": b"\x81\xa1a\xc6\xff\xff\xff\xff",
        "a text that claims 4 GB": b"\x81\xa1a\xdb\xff\xff\xff\xff",
        "an extension type": b"\x81\xa1a\xc9\xff\xff\xff\xff\x01",
        "a list as a key": b"\x81\x90\x01",
        "millions of empty lists": of([[[] for _ in range(4000)] for _ in range(50)])[:-9],
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", hostile_bodies())
def test_a_hostile_body_is_refused_in_little_memory(name: str) -> None:
    data = b"left/map\0" + hostile_bodies()[name]
    tracemalloc.start()
    try:
        with pytest.raises(MessageError):
            decode_message(data)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 64e6


def test_what_is_sent_is_within_the_bounds() -> None:
    value: Any = 1
    for _ in range(MAX_DEPTH - 1):
        value = {"a": value}
    data = encode_message("left", "map", {**HEADER, "extra": value})
    assert decode_message(data).fields["extra"] == value
    deeper = encode_message("left", "map", {**HEADER, "extra": [value]})
    with pytest.raises(MessageError, match="nested"):
        decode_message(deeper)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("[pattern]", "[map]\nnodes_x = 401\nnodes_y = 401\n[pattern]"), "tables of"),
        (("[pattern]", "[map]\nnodes_x = 10000\n[pattern]"), "less than or equal to 401"),
        (("per_side = 4", "per_side = 4000"), "less than or equal to 16"),
        (("length_m = 0.006", "length_m = 1e-300"), "greater than or equal to 0.00001"),
        (("schema = 1", "schema = " + "[" * 3000), "nested too deeply"),
        (("schema = 1", "schema = 1\n#" + "x" * (1 << 20)), "more than 1048576 bytes"),
    ],
)
def test_a_description_cannot_eat_the_machine(
    tmp_path: Path, change: tuple[str, str], said: str
) -> None:
    text = shipped_text("paper_square")
    assert change[0] in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(*change))
    with pytest.raises(DescriptionError, match=said):
        load_description(path)
