"""tactomo's client: pressure maps and contacts for a robot controller.

::

    from tactomo_client import subscribe

    for frame in subscribe("left_forearm"):
        for contact in frame.contacts:
            print(contact.id, contact.x_mm, contact.y_mm, contact.pressure_kpa)

`tactomo_client.aio` is the same for asyncio, `tactomo_client.recording` reads recorded frames, and
`tactomo_client.fake` tests a controller without a skin. The messages behind it are specified in
STREAM.md; `tactomo_client.messages` encodes and decodes them. Needs pyzmq, msgpack and numpy, and
nothing of the daemon.
"""

from tactomo_client.control import (
    BudgetInForce,
    CalibrationInForce,
    Control,
    Daemon,
    MethodInForce,
    RecordedFile,
    RecordingStarted,
    RunningRecording,
    Tare,
    request,
)
from tactomo_client.errors import (
    AlreadyRecording,
    BadArgument,
    CalibrationRefused,
    CannotWrite,
    ClientError,
    ControlError,
    KeysError,
    MessageError,
    NoAnswer,
    NoData,
    NoNetwork,
    NoReplay,
    NotRecording,
    RecordingError,
    StreamTimeout,
    TareRefused,
)
from tactomo_client.keys import Keys
from tactomo_client.messages import DEFAULT_CONTROL, DEFAULT_STREAM, DEFAULT_TWIN_CONTROL
from tactomo_client.schema import Answer, Contact, Event, Frame, Status
from tactomo_client.subscription import Subscription, subscribe

__all__ = [
    "DEFAULT_CONTROL",
    "DEFAULT_STREAM",
    "DEFAULT_TWIN_CONTROL",
    "AlreadyRecording",
    "Answer",
    "BadArgument",
    "BudgetInForce",
    "CalibrationInForce",
    "CalibrationRefused",
    "CannotWrite",
    "ClientError",
    "Contact",
    "Control",
    "ControlError",
    "Daemon",
    "Event",
    "Frame",
    "Keys",
    "KeysError",
    "MessageError",
    "MethodInForce",
    "NoAnswer",
    "NoData",
    "NoNetwork",
    "NoReplay",
    "NotRecording",
    "RecordedFile",
    "RecordingError",
    "RecordingStarted",
    "RunningRecording",
    "Status",
    "StreamTimeout",
    "Subscription",
    "Tare",
    "TareRefused",
    "request",
    "subscribe",
]
