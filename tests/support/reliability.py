"""docs/reliability.md: one row for each fault that was tried, as the test that tried it says."""

from __future__ import annotations

import os
import platform
import re
from dataclasses import dataclass
from pathlib import Path

import pytest

FIGURE = pytest.StashKey[str]()
MARKERS = ("fault", "measure")
_NO_FIGURE = "as promised"

_PAGE = """\
# Reliability

`make faults` writes this page: do not edit the page. Each row is a test in `tests/faults` of a
real `tactomo daemon` process on real pseudo-terminals and ZeroMQ sockets: the fault, the promise,
the method and the result. `make soak` and `-k` write their own rows anew. `ARGS='--scale 0.1'`
shortens the long measures, and their rows then state the scale. All of the suite takes hours.
`make test-all` tries more: exchanged and restarted boards, a channel that is lost, ports that come
later, a reconstruction that fails or hangs, a clock that is set, full, stuck and dead disks.

These promises hold:

- Frames return within a second after pulled cables, silence, noise; and after another board or a
  restart of one.
- No frame contains damaged bytes; each intact scan is published, or counted as dropped.
- Memory, threads and descriptors stay constant over a million scans and many subscribers.
- Hostile boards, files and web pages never end the daemon.
- A frozen converter or drive, a second skin on one daemon and a tare under a press are reported. A
  converter is frozen where a scan lacks noise against one of the last 16; an F test ends a dispute.
  A second tare under the same press stays disputed.

These limits remain:

- Latency is not guaranteed: on a busy computer it is tens of milliseconds, and scans are dropped.
- A kill loses up to 0.25 s of a recording. A full disk ends a recording to a file, and pauses a
  recording to a folder.
- At the very first tare, a frozen converter or an object on the skin looks like a skin at rest
  ([what to do](your_own_sensor.md)).
- A board that sends more than 16 old scans round and round is believed.
- A wide press is missing while noise hides it: on the simulated paper's skin, pads of 60 to 138 mm
  below 0.1 to 0.7 kPa, whether they come within a second or ten minutes.
- Scans that one board delays by half a second behind an honest counter can make a sliding press
  look like drift, or like two contacts: pressures and places are then wrong, without a flag.
- A board that averages its scans over 20 mm of a sliding press can show it as two, without a
  flag.
- A structure port that reads the magnitude sheet, too, looks like a skin at rest: presses that the
  magnitude sheet does not feel are missing, without a flag. Harder presses are flagged.
- Where one daemon reads the magnitude sheet of one skin and the structure sheet of another, a press
  on the second is `below`, whatever its pressure; a press on the first is flagged or missing
  ([what to do](many_skins.md#exchanged-cables)).
- A gain that falls by a tenth under a press counts as drift, mostly without a flag: pressures keep
  within two standard uncertainties, which grow to 14 kPa. Tare once nothing presses.

Machine: {machine}.

## Faults

{faults}

## Measures

Latency is the age of the data: from the moment at which a dual scan's last byte would have come
with the least delay ([STREAM.md](../clients/STREAM.md#when-a-scan-was-acquired)) to publication
(*published*), and to the arrival in another process (*arrived*). Rows give the percentiles that at
least ten frames exceed: p99 from 1,000 frames, p99.9 from 10,000. *Read* counts from the last byte
read to publication. A sliding contact moves at 10 cm/s, a moving contact by 4 mm per dual scan. The
kernel counts the processor time.

{measures}
"""


@dataclass(frozen=True)
class Row:
    """One line of the page."""

    table: str
    fault: str
    promise: str
    tried: str
    figure: str


def row_of(item: pytest.Item, report: pytest.TestReport) -> Row | None:
    """Return the row that a finished test makes; None for a stage of it that makes none."""
    marker = next((m for name in MARKERS if (m := item.get_closest_marker(name))), None)
    if marker is None or (report.when != "call" and report.passed):
        return None
    if report.when == "teardown":
        return None
    case = getattr(item, "callspec", None)
    fault, promise, tried = (text.format(**(case.params if case else {})) for text in marker.args)
    figure = item.stash.get(FIGURE, _NO_FIGURE)
    if report.skipped:
        figure = f"not tried: {_reason(report)}"
    if report.failed:
        figure = f"**not kept**: {_complaint(report)} ({item.stash.get(FIGURE, 'no figure')})"
    scale = item.config.getoption("scale")
    if "scale" in getattr(item, "fixturenames", ()) and scale != 1 and not report.skipped:
        figure = f"at scale {scale:g}: {figure}"
    return Row(marker.name, fault, promise, tried, figure)


def write_page(path: Path, rows: list[Row]) -> None:
    """Write the page whole."""
    path.write_text(
        _PAGE.format(
            machine=_machine(),
            faults=_table(("Fault", "Promise", "How it was tried", "Figure"), rows, "fault"),
            measures=_table(("Measure", "Aim", "How", "Figure"), rows, "measure"),
        ),
        encoding="utf-8",
    )


def replace_rows(path: Path, rows: list[Row]) -> None:
    """Write these rows of the page anew, found by their first cell; new ones end their table."""
    lines = path.read_text(encoding="utf-8").splitlines()
    for row in rows:
        new, names = _line(row), [_name(line) for line in lines]
        if _name(new) in names:
            lines[names.index(_name(new))] = new
        else:
            end = lines.index("## Measures") if row.table == "fault" else len(lines)
            last = max(number for number in range(end) if lines[number].startswith("|"))
            lines.insert(last + 1, new)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _name(line: str) -> str:
    return line.split(" | ")[0]


def _table(head: tuple[str, ...], rows: list[Row], table: str) -> str:
    lines = [_cells(*head), _cells(*("---",) * len(head))]
    return "\n".join(lines + [_line(row) for row in rows if row.table == table])


def _line(row: Row) -> str:
    return _cells(row.fault, row.promise, row.tried, row.figure)


def _cells(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _reason(report: pytest.TestReport) -> str:
    reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    return reason.removeprefix("Skipped: ")


def _complaint(report: pytest.TestReport) -> str:
    crash = getattr(report.longrepr, "reprcrash", None)
    text = crash.message if crash is not None else str(report.longrepr)
    return re.sub(r"\s+", " ", text.splitlines()[0] if text else "")[:160]


def _machine() -> str:
    """Name the processor, the cores that may be used, the memory and the versions."""
    try:
        info = Path("/proc/cpuinfo").read_text()
    except OSError:
        info = ""
    found = re.search(r"model name\s*:\s*(.+)", info)
    cores = len(os.sched_getaffinity(0))
    load = os.getloadavg()[2]  # over 15 minutes; what else runs here shows in latencies
    memory_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    return (
        f"{found[1] if found else platform.machine()}, {cores} cores, {memory_gb:.0f} GB, "
        f"Linux {platform.release().split('-')[0]}, Python {platform.python_version()}, "
        f"load average {load:.1f}"
    )
