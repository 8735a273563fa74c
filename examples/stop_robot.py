"""Stop a robot as soon as a contact presses with 150 kPa, or as soon as the skin cannot tell.

Skin:   .venv/bin/tactomo demo    (press the page's skin harder than 150 kPa)
Run:    .venv/bin/python examples/stop_robot.py [sensor] [address of the stream]
Needs:  `tactomo-client` alone.
"""

import sys
import time

from tactomo_client import DEFAULT_STREAM, Frame, subscribe

LIMIT_KPA = 150.0
SENSOR = sys.argv[1] if len(sys.argv) > 1 else "skin"
STREAM = sys.argv[2] if len(sys.argv) > 2 else DEFAULT_STREAM


def reason_to_stop(frame: Frame | None) -> str | None:
    """Say why the robot must stop; None while the robot may move."""
    if frame is None or frame.is_stale:
        return "no frame within half a second"  # not known, which is not "nothing pressed"
    if frame.flags:
        return f"not to be trusted: {', '.join(frame.flags)}"
    for contact in frame.contacts:
        kpa = contact.pressure_kpa
        if kpa is None and contact.pressure_range != "below":
            return f"contact {contact.id}: pressure unknown"
        if kpa is not None and kpa >= LIMIT_KPA:
            return f"contact {contact.id}: {kpa:.0f} kPa"
    return None


with subscribe(SENSOR, address=STREAM, kind="contacts", latest_only=True) as skin:
    frame = skin.wait(10.0)
    print("moving", flush=True)
    while not (reason := reason_to_stop(frame)):
        time.sleep(0.001)  # one turn of the robot's control loop: command its velocity here
        frame = skin.latest()
print(f"stopped: {reason}")
