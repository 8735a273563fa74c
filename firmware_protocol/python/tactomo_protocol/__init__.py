"""Wire protocol v1 between a tactile skin's firmware and its host: packets, encoder, decoder.

::

    decoder = Decoder()                      # one for each port
    for packet in decoder.feed(port.read()):
        match packet:
            case Scan(): ...
            case Hello(): ...
    port.write(encode(Command(CommandCode.START, request=1)))

The specification is `firmware_protocol/PROTOCOL.md`; test vectors lie beside it.
"""

from .codec import (
    MAX_DEVICE_US,
    MAX_FRAME_BYTES,
    MAX_RATE_HZ,
    MAX_SAMPLES,
    MAX_STRING_BYTES,
    MIN_RATE_HZ,
    PROTOCOL_VERSION,
    Decoder,
    DecoderCounts,
    FieldError,
    encode,
)
from .packets import (
    SCAN_COUNTERS,
    Acknowledge,
    AckStatus,
    Channel,
    Command,
    CommandCode,
    CompanionReading,
    Hello,
    Packet,
    SampleFormat,
    Samples,
    Scan,
    ScanFlag,
    UnknownPacket,
)

__all__ = [
    "MAX_DEVICE_US",
    "MAX_FRAME_BYTES",
    "MAX_RATE_HZ",
    "MAX_SAMPLES",
    "MAX_STRING_BYTES",
    "MIN_RATE_HZ",
    "PROTOCOL_VERSION",
    "SCAN_COUNTERS",
    "AckStatus",
    "Acknowledge",
    "Channel",
    "Command",
    "CommandCode",
    "CompanionReading",
    "Decoder",
    "DecoderCounts",
    "FieldError",
    "Hello",
    "Packet",
    "SampleFormat",
    "Samples",
    "Scan",
    "ScanFlag",
    "UnknownPacket",
    "encode",
]
