"""What is wrong with a running daemon, by its status alone, worst first and with a next step.

The status carries it, and whoever shows a status prints it: nobody else judges.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from tactomo_client.schema import HealthIssue

from tactomo.events import RECORDED
from tactomo.plain import counted

CORRUPT_NOTED = 1e-3  # share of packets: a line that loses one now and then still serves
DROPPED_NOTED = 1e-2  # share of the dual scans
FEWEST_INCOMPLETE = 3  # fewer are no rate: one of the first 41 says little of the next thousand
LATENCY_TIMER_MS = 2  # what an FTDI adapter holds back for longer is felt

FLAG_ERRORS = frozenset(
    (
        *("no_reference", "reference_mismatch", "no_usable_scan", "electrode_fault", "noise_high"),
        *("saturated", "channels_swapped"),
    )
)
"""Flags of what has to be mended before frames say what presses; the others are warnings."""
FLAG_ADVICE: Mapping[str, tuple[str, str]] = {
    "magnitude_missing": (
        "no usable scans of the magnitude channel",
        "check that channel's port, cable and last event; until then pressures are unknown",
    ),
    "structure_missing": (
        "no usable scans of the structure channel",
        "check that channel's port, cable and last event; until then shapes are coarser",
    ),
    "no_reference": ("not tared yet", "leave the skin alone and run `tactomo tare`"),
    "reference_mismatch": (
        "the reference does not look like this sensor unloaded",
        "take everything off the skin and run `tactomo tare`; is it the right sensor?",
    ),
    "reference_disputed": (
        "at the start, or at the tare, something seemed to lie on the skin",
        "take everything off; if contacts are still shown then, run `tactomo tare`; if this stays, "
        "touch the skin, let go, and tare again",
    ),
    "no_usable_scan": (
        "nothing is measured: no contacts does not mean nothing pressed",
        "check the cables, and run `tactomo doctor` to find the leads",
    ),
    "misfit_high": (
        "the model does not explain the data",
        "take everything off and run `tactomo tare`; if it stays, run `tactomo doctor`",
    ),
    "not_converged": (
        "the reconstruction ran out of time",
        "raise the budget, or free the processor",
    ),
    "invalid_voltage": (
        "some voltages are impossible and were left out",
        "run `tactomo doctor` to find the lead",
    ),
    "saturated": ("the converter clips", "lower the gain or the current"),
    "electrode_fault": (
        "an electrode reads nonsense and was left out",
        "check its lead and contact, then run `tactomo tare`",
    ),
    "noise_high": (
        "voltages that should be equal differ widely",
        "look for interference or a loose ground; `tactomo doctor` measures it",
    ),
    "low_confidence": (
        "the network expects this map to be wrong",
        "do not act on it; run `tactomo tare`, and `tactomo doctor` if it stays",
    ),
    "channels_swapped": (
        "the magnitude channel changes more than the structure channel",
        "exchange the two plugs, then run `tactomo tare`",
    ),
    "channels_skewed": (
        "the two channels' scans come from different instants",
        "check the sync line between the two boards",
    ),
    "creeping": (
        "the skin recovers slowly from a press, and may hide a light touch",
        "leave the skin alone for a while, or run `tactomo tare` with nothing on it",
    ),
    "untaught": (
        "this press is unlike all taught presses: the physics alone locates it",
        "teach more of the skin by `tactomo teach live`",
    ),
    "companion_missing": (
        "a companion of the sensor description has no reading within its limits",
        "check its cable and `limits`; the sheets are used alone meanwhile",
    ),
    "companion_disputed": (
        "a companion contradicts the sheets and is left out",
        "check its gain and offset, and that it was tared with nothing on the skin",
    ),
}
FASTER = "give the daemon more of the processor, or choose a faster method or a budget"
STATES: Mapping[str, tuple[str, str]] = {
    "waiting_for_port": ("a port is not there yet", "see what is wrong with the ports"),
    "waiting_for_data": ("no scan has come yet", "see what is wrong with the ports"),
    "stale": ("scans have stopped coming", "see what is wrong with the ports"),
    "late": ("scans come, and frames come late", FASTER),
}
FIRMWARE_STEP = (
    "the line is good: correct the firmware, by firmware_protocol/PROTOCOL.md; the event "
    "firmware_fault names the rule"
)
CABLE_STEP = "check the cable, its shield and the baud rate"
TARING = ("warning", "a reference is being taken", "leave the skin alone until it runs")


def health_issues(status: Mapping[str, Any]) -> list[HealthIssue]:
    """Return what is wrong by the fields of a status message, errors first; empty if nothing is."""
    of_skin = [
        *_of_state(status),
        *(each for port in status.get("ports") or [] for each in _of_port(port)),
        *_of_flags(status),
        *_of_losses(status),
    ]
    if status.get("replay"):
        here = (FASTER,)  # what this computer lacks, not the recorded one
        of_skin = [i if i.next_step in here else replace(i, next_step=RECORDED) for i in of_skin]
    found = [*of_skin, *_of_method(status), *_of_recorder(status.get("recorder") or {})]
    return sorted(found, key=lambda issue: issue.severity != "error")


def _of_state(status: Mapping[str, Any]) -> Iterator[HealthIssue]:
    known = STATES.get(str(status.get("state")))
    if known is not None:
        yield HealthIssue("error", *known)


PORT_STATES: Mapping[str, str] = {
    "closed": "plug it in, or check the cable; it is tried again until it is there",
    "refused": "give the daemon the sensor's own device and description",
    "garbage": "check the baud rate, and that the firmware speaks the protocol",
    "silent": "check that the device has power and that this is its port",
    "idle": "is the device waiting for a trigger, or was it reset?",
    "faulty": FIRMWARE_STEP,
}


def _of_port(port: Mapping[str, Any]) -> Iterator[HealthIssue]:
    url = port.get("url")
    step = PORT_STATES.get(str(port.get("state")))
    if step is not None:
        because = f": {port['problem']}" if port.get("problem") else ""
        yield HealthIssue("error", f"{url} is {port['state']}{because}", step)
    recent = port.get("received_last_minute") or {}
    counts = [recent.get(name) or 0 for name in ("packets", "corrupt", "faulty")]
    for count, happened, step in (
        (counts[1], "came damaged", CABLE_STEP),
        (counts[2], "broke the protocol", FIRMWARE_STEP),
    ):
        if count > CORRUPT_NOTED * sum(counts):
            share = f"{count} of {sum(counts)} packets {happened} within the last minute"
            yield HealthIssue("warning", f"{url}: {share}", step)
    timer_ms = port.get("latency_timer_ms") or 0
    if timer_ms > LATENCY_TIMER_MS:
        step = "set it to 1 ms, as the udev rule of tactomo does"
        yield HealthIssue("warning", f"{url}: its adapter holds bytes back for {timer_ms} ms", step)


def _of_method(status: Mapping[str, Any]) -> Iterator[HealthIssue]:
    method, reason = status.get("tier_requested"), str(status.get("tier_reason"))
    if reason.startswith(f"method {method} failed"):
        what = f"{reason}; frames are {status.get('tier')}'s"
        yield HealthIssue("error", what, "mend the method, or choose another: `tactomo method`")


def _of_flags(status: Mapping[str, Any]) -> Iterator[HealthIssue]:
    for flag in status.get("flags") or []:
        severity = "error" if flag in FLAG_ERRORS else "warning"
        what, step = FLAG_ADVICE[flag]
        if flag == "no_reference" and status.get("state") == "taring":
            severity, what, step = TARING
        is_explained = flag in ("electrode_fault", "misfit_high") or flag.startswith("companion_")
        because = status.get("tier_reason") if is_explained else None
        yield HealthIssue(severity, f"{what} ({because})" if because else what, step)


def _of_losses(status: Mapping[str, Any]) -> Iterator[HealthIssue]:
    recent = status.get("last_minute") or {}
    dropped, incomplete = recent.get("dropped_scans") or 0, recent.get("incomplete_scans") or 0
    came = (recent.get("frames") or 0) + dropped
    of = f"of {counted(came, 'dual scan')} within the last minute"
    is_busy = dropped > DROPPED_NOTED * came
    if is_busy:
        yield HealthIssue("warning", f"{dropped} {of} were left out", FASTER)
    if incomplete > DROPPED_NOTED * came:
        # A busy computer loses scans, too: then nothing is known against the cable.
        severity = "warning" if is_busy or incomplete < FEWEST_INCOMPLETE else "error"
        cable = "check the cable of the channel that is missing; if it comes late, sync_wait_ms"
        step = f"{FASTER}; and {cable}" if is_busy else cable
        yield HealthIssue(severity, f"{incomplete} {of} lacked a channel", step)


def _of_recorder(recorder: Mapping[str, Any]) -> Iterator[HealthIssue]:
    if recorder.get("waits_for"):
        step = "see that the folder is there and the disk takes more; recording goes on by itself"
        yield HealthIssue("error", f"nothing is recorded: {recorder['waits_for']}", step)
    elif recorder.get("failure"):
        step = "free some space or mend the disk, then record anew: `tactomo record start`"
        yield HealthIssue("error", f"a recording ended early: {recorder['failure']}", step)
