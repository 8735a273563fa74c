"""What `tactomo doctor` finds about the way of the scans: the line and the frames."""

from __future__ import annotations

from typing import Any

from tactomo_models.health.findings import Finding, Level

from tactomo.cli.doctor.evidence import Evidence, Heard
from tactomo.service.health_issues import CORRUPT_NOTED, FIRMWARE_STEP

LOST_SHARE = 0.01  # of the dual scans: less is advice
LATE_SHARE = 0.5  # what a busy computer does to fewer is advice: most frames are in time
FEWEST_LOST = 3  # below that it is no rate: one of the first 41 says little of the next thousand


def stream_findings(evidence: Evidence) -> list[Finding]:
    """Return what was found about line and frames; empty for a file of arrays."""
    found: list[Finding] = []
    if evidence.heard is not None:
        found += [_packets_found(evidence.heard), _lost_found(evidence, evidence.heard.lost)]
    if evidence.frames:
        found.append(_pressed_found(evidence))
    return [*found, *evidence.issues]


def _packets_found(heard: Heard) -> Finding:
    total = heard.packets + heard.corrupt + heard.faulty
    counts = {"packets": heard.packets, "corrupt": heard.corrupt, "faulty": heard.faulty}
    figures = {name: float(count) for name, count in counts.items()}
    if heard.faulty > heard.corrupt:
        return Finding(
            "packets",
            Level.FAULT,
            f"{heard.faulty} of {total} are intact and break the protocol",
            FIRMWARE_STEP,
            {**figures},
        )
    if not heard.corrupt:
        return Finding("packets", Level.OK, f"{heard.packets}, none damaged", "", {**figures})
    share = heard.corrupt / total
    return Finding(
        "packets",
        Level.FAULT if share > CORRUPT_NOTED else Level.ADVICE,
        f"{heard.corrupt} of {total} came damaged ({share:.2%})",
        "check the cable, its shield and the baud rate",
        {**figures},
    )


def _lost_found(evidence: Evidence, lost: int) -> Finding:
    count = max(len(scans.volts) for scans in evidence.scans.values())
    figures: dict[str, Any] = {"number": float(lost)}
    if not lost:
        return Finding("lost_scans", Level.OK, f"none of {count} dual scans", "", figures)
    # Scans that came and were left out tell that the computer was busy: then others may have been
    # lost for the same reason, and nothing is known against cable and board.
    is_busy = evidence.left_out > LOST_SHARE * count
    share = lost / (count + lost)
    is_fault = share > (LATE_SHARE if is_busy else LOST_SHARE) and lost >= FEWEST_LOST
    return Finding(
        "lost_scans",
        Level.FAULT if is_fault else Level.ADVICE,
        f"{lost} of {count + lost} dual scans ({share:.1%}) did not arrive",
        "the computer is busy: repeat when the computer is idle"
        if is_busy
        else "is the line too slow for the rate, or the computer too busy?",
        figures,
    )


def _pressed_found(evidence: Evidence) -> Finding:
    figures: dict[str, Any] = {"frames": float(evidence.frames), "pressed": float(evidence.pressed)}
    if not evidence.pressed:
        return Finding("frames", Level.OK, f"{evidence.frames}, nothing pressed", "", figures)
    return Finding(
        "frames",
        Level.ADVICE,
        f"something presses in {evidence.pressed} of {evidence.frames} frames",
        "leave the skin alone while it is examined; if nothing touches it, run `tactomo tare`",
        figures,
    )
