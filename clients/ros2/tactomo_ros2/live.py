"""A running sensor's frames as ROS 2 messages, for a node that publishes them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from tactomo_client import Event, Frame, Status, Subscription
from tactomo_client.schema import Mount

from tactomo_ros2.messages import RosMessage, issue_diagnostics, ros_messages, stale_diagnostics

WAIT_S: Final = 0.2
"""How soon a stop is noticed."""
REMIND_S: Final = 1.0
"""How often silence is told: as often as diagnostics are published by convention (REP 107)."""


def run(
    skin: Subscription[Frame | Status | Event],
    publish: Callable[[RosMessage], None],
    is_over: Callable[[], bool],
) -> None:
    """Publish every frame, what is wrong, and once a second that none comes, until `is_over`.

    Raises:
        KeysError: the daemon does not let us in.
    """
    last: Frame | None = None
    mount: Mount | None = None
    due_s = time.monotonic() + REMIND_S
    while not is_over():
        item = skin.wait(WAIT_S)
        if isinstance(item, Status):
            mount = None if item.description is None else item.description.mount
            publish(issue_diagnostics(item, time.time_ns()))
        elif isinstance(item, Frame):
            last = item
            at_ns = last.acquired_realtime_ns
            for message in ros_messages(last, at_ns, last.age_s, mount):
                publish(message)
            due_s = time.monotonic() + REMIND_S
        if time.monotonic() >= due_s:
            due_s += REMIND_S
            publish(stale_diagnostics(skin.sensor, last, time.time_ns()))
