"""What a recording's page is drawn from: contacts, misfit and timing over time, and some maps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, TypeAlias

from tactomo.cli.files.recorded_frames import RecordedFrames, TimedFrame, missing

if TYPE_CHECKING:
    from tactomo_client import Contact

MAPS_SHOWN: Final = 6
Track: TypeAlias = "list[tuple[float, Contact]]"
"""One contact over time: when, in seconds, and how it was then."""
SHORTEST_S: Final = 0.15  # stretches shorter than this are not shown, unless there is no other


@dataclass(slots=True)
class Course:
    """The frames of a recording without their images, one list entry for each."""

    sensor: str
    start_ns: int  # when the recording began, nanoseconds since 1970
    times_s: list[float] = field(default_factory=list)
    """When each frame was acquired, seconds from there."""
    pressed: list[frozenset[str]] = field(default_factory=list)  # which contacts were there
    tiers: list[str] = field(default_factory=list)
    flags: list[frozenset[str]] = field(default_factory=list)
    misfits: list[float | None] = field(default_factory=list)
    ages_s: list[float | None] = field(default_factory=list)
    """How old each was when it was published; None for what was made of the recording just now."""
    lost: list[int] = field(default_factory=list)
    """How many frames were published since the one before, but are not in the recording."""
    left_out: list[int] = field(default_factory=list)
    """How many dual scans were taken since the one before, but not reconstructed in time."""
    tracks: dict[str, Track] = field(default_factory=dict)
    """Contacts by identity, in the order in which they came."""

    @property
    def contacts(self) -> list[Contact]:
        """All contacts of all frames."""
        return [contact for track in self.tracks.values() for _, contact in track]


def read_course(frames: RecordedFrames) -> Course:
    """Read the frames of a recording without their images."""
    course = Course(frames.sensor, frames.start_ns)
    sessions: dict[str, str] = {}
    last: TimedFrame | None = None
    for moment in frames.with_progress(frames.moments("contacts"), "reading"):
        frame = moment.frame
        run = sessions.setdefault(frame.session, "'" * len(sessions))  # ids begin anew in each
        course.times_s.append(moment.time_s)
        course.pressed.append(frozenset(f"{c.id}{run}" for c in frame.contacts))
        course.tiers.append(frame.tier or "none")
        course.flags.append(frame.flags)
        course.misfits.append(frame.misfit)
        course.ages_s.append(moment.age_s)
        lost = missing(last, moment, "sequence")
        course.lost.append(lost)
        course.left_out.append(max(0, missing(last, moment, "scan_counter") - lost))
        for contact in frame.contacts:
            track = course.tracks.setdefault(f"{contact.id}{run}", [])
            track.append((moment.time_s, contact))
        last = moment
    return course


def read_maps(frames: RecordedFrames, course: Course) -> list[TimedFrame]:
    """Read the frames of the telling moments, with their images."""
    wanted = [course.times_s[i] for i in telling_moments(course.times_s, course.pressed)]
    found: list[TimedFrame] = []
    for moment in frames.with_progress(frames.moments(), "reading maps"):
        if len(found) < len(wanted) and moment.time_s >= wanted[len(found)]:
            found.append(moment)
        if len(found) == len(wanted):
            break
    return found


def telling_moments(
    times_s: list[float], pressed: list[frozenset[str]], count: int = MAPS_SHOWN
) -> list[int]:
    """Return which frames tell most, in the order of time; at most `count`.

    The recording falls into stretches with the same contacts. The longest ones in which something
    is pressed get a frame each; what is left goes to those with the most time for each frame.
    """
    stretches = [s for s in _stretches(times_s, pressed) if pressed[s[0]]]
    if not stretches:
        return [len(times_s) // 2]
    length = {s: times_s[s[1]] - times_s[s[0]] for s in stretches}
    lasting = [s for s in stretches if length[s] >= SHORTEST_S] or stretches
    shares = dict.fromkeys(sorted(lasting, key=lambda s: -length[s])[:count], 1)
    while sum(shares.values()) < min(count, sum(end - begin + 1 for begin, end in shares)):
        roomy = [s for s in shares if shares[s] < s[1] - s[0] + 1]
        shares[max(roomy, key=lambda s: length[s] / shares[s])] += 1
    return sorted(
        begin + round((end - begin) * (part + 0.5) / share)
        for (begin, end), share in shares.items()
        for part in range(share)
    )


def _stretches(times_s: list[float], pressed: list[frozenset[str]]) -> list[tuple[int, int]]:
    """Return the first and the last frame of each stretch with the same contacts."""
    begins = [i for i in range(len(pressed)) if i == 0 or pressed[i] != pressed[i - 1]]
    ends = [begin - 1 for begin in begins[1:]] + [len(times_s) - 1]
    return list(zip(begins, ends, strict=True))
