"""The test vectors of wire protocol v1, `firmware_protocol/vectors`, and packets in their form."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from tactomo_protocol import (
    Command,
    CompanionReading,
    Hello,
    Packet,
    SampleFormat,
    Samples,
    Scan,
    UnknownPacket,
)

FOLDER = Path(__file__).parents[2] / "firmware_protocol" / "vectors"
JsonMap = dict[str, Any]


def load(name: str) -> list[JsonMap]:
    """The vectors of `packets.json` or `streams.json`."""
    vectors: list[JsonMap] = json.loads((FOLDER / name).read_text("utf-8"))["vectors"]
    return vectors


def fields(packet: Packet) -> JsonMap:
    """A packet's fields as the vector files hold them.

    Enumerations are numbers. What JSON cannot hold exactly everywhere is a string: the u64 clock
    in decimal, a float32 sample as its bits in hex, a NaN rate as "nan".
    """
    match packet:
        case Scan():
            return {
                "packet": "scan",
                "channel": packet.channel.number,
                "flags": int(packet.flags),
                "counter": packet.counter,
                "device_us": str(packet.device_us),
                **_samples_fields(packet.samples),
            }
        case Hello():
            channels = [channel.number for channel in packet.channels]
            return {"packet": "hello", **asdict(packet), "channels": channels}
        case CompanionReading():
            return {
                "packet": "companion",
                "index": packet.index,
                "flags": int(packet.flags),
                "device_us": str(packet.device_us),
                "value": f"0x{np.float32(packet.value).view(np.uint32):08x}",
            }
        case UnknownPacket():
            return {"packet": "unknown", "type": packet.type, "body": packet.body.hex()}
        case Command(rate_hz=rate_hz) if math.isnan(rate_hz):
            return {"packet": "command", **asdict(packet), "rate_hz": "nan"}
    return {"packet": type(packet).__name__.lower(), **asdict(packet)}


def _samples_fields(samples: Samples) -> JsonMap:
    if samples.dtype == np.float32:
        bits = [f"0x{value:08x}" for value in samples.view(np.uint32)]
        return {"sample_format": int(SampleFormat.FLOAT32), "samples": bits}
    sample_format = SampleFormat.INT16 if samples.dtype == np.int16 else SampleFormat.INT32
    return {"sample_format": int(sample_format), "samples": samples.tolist()}
