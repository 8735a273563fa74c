"""tactomo's client: pressure maps and contacts for a robot controller.

::

    from tactomo_client import subscribe

    for frame in subscribe("left_forearm"):
        for contact in frame.contacts:
            print(contact.id, contact.x_mm, contact.y_mm, contact.pressure_kpa)

The messages behind it are specified in STREAM.md; `tactomo_client.messages` encodes and decodes
them. Needs pyzmq, msgpack and numpy, and nothing of the daemon.
"""

from tactomo_client.control import request
from tactomo_client.errors import (
    ClientError,
    ControlError,
    KeysError,
    MessageError,
    RecordingError,
    StreamTimeout,
)
from tactomo_client.frame import Contact, Frame
from tactomo_client.keys import Keys
from tactomo_client.messages import (
    DEFAULT_CONTROL,
    DEFAULT_STREAM,
    DEFAULT_TWIN_CONTROL,
)
from tactomo_client.subscription import Subscription, subscribe

__all__ = [
    "DEFAULT_CONTROL",
    "DEFAULT_STREAM",
    "DEFAULT_TWIN_CONTROL",
    "ClientError",
    "Contact",
    "ControlError",
    "Frame",
    "Keys",
    "KeysError",
    "MessageError",
    "RecordingError",
    "StreamTimeout",
    "Subscription",
    "request",
    "subscribe",
]
