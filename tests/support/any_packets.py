"""Hypothesis strategies for packets of every type, with any values that the wire can carry."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from tactomo_protocol import (
    MAX_DEVICE_US,
    MAX_RATE_HZ,
    MAX_SAMPLES,
    MIN_RATE_HZ,
    Acknowledge,
    AckStatus,
    Channel,
    Command,
    CommandCode,
    CompanionReading,
    Hello,
    Packet,
    SampleFormat,
    Scan,
    ScanFlag,
    UnknownPacket,
)

U8 = st.integers(0, 2**8 - 1)
POSITIVE = st.floats(0, exclude_min=True, allow_nan=False, allow_infinity=False)


@st.composite
def scans(draw: st.DrawFn, max_samples: int = MAX_SAMPLES) -> Scan:
    dtype = draw(st.sampled_from(SampleFormat)).dtype
    count = draw(st.one_of(st.integers(1, min(12, max_samples)), st.integers(1, max_samples)))
    # Any bits at all, so that every NaN is among them; runs of one value make long COBS blocks.
    size = count * dtype.itemsize
    data = draw(
        st.one_of(st.binary(min_size=size, max_size=size), U8.map(lambda b: bytes([b]) * size))
    )
    return Scan(
        channel=draw(st.sampled_from(Channel)),
        counter=draw(st.integers(0, 2**32 - 1)),
        device_us=draw(st.integers(0, MAX_DEVICE_US)),
        flags=ScanFlag(draw(U8)),
        samples=np.frombuffer(data, dtype),
    )


def names() -> st.SearchStrategy[str]:
    """Strings that a hello may carry: categories Cc and Cs are the controls and surrogates."""
    alphabet = st.characters(exclude_categories=["Cc", "Cs"])
    return st.text(alphabet, min_size=1, max_size=64).filter(lambda s: len(s.encode()) <= 64)


@st.composite
def hellos(draw: st.DrawFn) -> Hello:
    electrodes = draw(st.integers(2, 255))
    offsets = st.integers(1, electrodes - 1)
    channels = draw(st.sets(st.sampled_from(Channel), min_size=1))
    return Hello(
        device_id=draw(names()),
        firmware=draw(names()),
        channels=tuple(sorted(channels)),
        electrodes=electrodes,
        drive_offset=draw(offsets),
        measure_offset=draw(offsets),
        samples_per_scan=draw(st.integers(1, MAX_SAMPLES)),
        sample_format=draw(st.sampled_from(SampleFormat)),
        volts_per_count=draw(POSITIVE),
        scan_rate_hz=draw(st.just(0.0) | st.floats(MIN_RATE_HZ, MAX_RATE_HZ)),
    )


COMMANDS = st.builds(Command, U8.filter(lambda code: code != CommandCode.SET_RATE), U8) | st.builds(
    Command, st.just(CommandCode.SET_RATE), U8, POSITIVE
)
ACKNOWLEDGES = st.builds(Acknowledge, U8, U8, st.sampled_from(AckStatus))
COMPANIONS = st.builds(
    CompanionReading,
    U8,
    U8.map(ScanFlag),
    st.integers(0, MAX_DEVICE_US),
    st.floats(width=32, allow_nan=False, allow_infinity=False),
)
UNKNOWNS = st.builds(
    UnknownPacket, U8.filter(lambda kind: kind not in (1, 2, 3, 4, 0x81)), st.binary(max_size=300)
)
PACKETS: st.SearchStrategy[Packet] = st.one_of(
    scans(), hellos(), COMMANDS, ACKNOWLEDGES, COMPANIONS, UNKNOWNS
)
SMALL_PACKETS: st.SearchStrategy[Packet] = st.one_of(
    scans(max_samples=4), hellos(), COMMANDS, ACKNOWLEDGES, COMPANIONS
)
