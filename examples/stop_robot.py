"""Stop a robot when a contact presses with 150 kPa, or when the skin cannot tell; then go on.

Skin:   .venv/bin/tactomo demo    (press the page's skin harder than 150 kPa, and let go)
Run:    .venv/bin/python examples/stop_robot.py [sensor] [address of the stream]
Needs:  `tactomo-client` alone.
"""

import sys
import time

from tactomo_client import DEFAULT_STREAM, Answer, Frame, subscribe
from tactomo_client.appearance import pressure_words

STOP_KPA, GO_KPA = 150.0, 140.0  # apart, so that noise does not stop and start the robot
SETTLE_S = 0.3  # the robot may move without an answer for so long, and needs a "no" for so long
NAME = sys.argv[1] if len(sys.argv) > 1 else "skin"
STREAM = sys.argv[2] if len(sys.argv) > 2 else DEFAULT_STREAM


def reason(frame: Frame | None) -> str:
    """Say why the robot must not move."""
    if frame is None or frame.is_stale:
        return "no fresh frame"  # not known, which is not "nothing pressed"
    if frame.flags:
        return f"not to be trusted: {', '.join(sorted(frame.flags))}"
    hard = (c for c in frame.contacts if c.exceeds(STOP_KPA) is not Answer.NO)
    return ", ".join(f"contact {c.id}: {pressure_words(c)}" for c in hard)


with subscribe(NAME, address=STREAM, kind="contacts", latest_only=True, stale_after_s=0.2) as skin:
    moves, as_it_should_s = False, time.monotonic()
    while True:
        frame, now_s = skin.latest(), time.monotonic()
        answer = frame.exceeds(STOP_KPA if moves else GO_KPA) if frame else Answer.CANNOT_TELL
        if (answer is Answer.NO) == moves:
            as_it_should_s = now_s
        if (moves and answer is Answer.YES) or now_s - as_it_should_s > SETTLE_S:
            moves, as_it_should_s = not moves, now_s
            print("moves" if moves else f"stops: {reason(frame)}", flush=True)
        time.sleep(0.001)  # one turn of the robot's control loop: command its velocity here
