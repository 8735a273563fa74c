"""`tactomo recover`: what is intact in a cut or damaged recording, as a new and whole one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tactomo.cli.options import RecordingFile, examples, need_recording, typer_app
from tactomo.cli.output import progress_bar, say

if TYPE_CHECKING:
    from tactomo.recordings.recording import Summary
    from tactomo.recordings.recovery import Recovery

app = typer_app()


@app.command(
    epilog=examples("tactomo recover grasp.mcap", "tactomo recover grasp.mcap -o whole.mcap")
)
def recover(
    recording: RecordingFile,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", dir_okay=False, help="The new file. [FILE-recovered.mcap beside it]"
        ),
    ] = None,
) -> None:
    """Rewrite a cut or damaged recording with an index, so that any MCAP tool opens it.

    Keeps every part that a checksum confirms, also beyond damage in the middle, and lists the
    losses. The damaged file stays unchanged. A replay of the new file gives the maps of the live
    run. After a gap, the replay starts cold; where the reference is lost, there are no maps.
    """
    need_recording(recording)
    from tactomo.recordings.recording import open_recording
    from tactomo.recordings.recovery import recover as rewrite

    target = output or recording.parent / f"{recording.stem}-recovered.mcap"
    with progress_bar("recovering") as show:
        recovery = rewrite(recording, target, show)
    say(f"{target}: {_kept(open_recording(target).summary)}")
    for line in _lost(recovery):
        say(line)


def _kept(summary: Summary) -> str:
    scans = ", ".join(f"{count} {c}" for c, count in summary.scans.items())
    return f"kept {summary.duration_s:.1f} s, {scans or 'no'} scans, {summary.frames} frames"


def _lost(recovery: Recovery) -> list[str]:
    if recovery.is_intact:
        return ["lost: nothing"]
    lines = [f"lost: {recovery.lost_bytes} bytes"]
    for gap in recovery.gaps:
        scans = ", ".join(f"{n} {channel}" for channel, n in gap.scans.items())
        lines.append(f"  a gap of {gap.seconds:.2f} s: {scans or 'an unknown number of'} scans")
    if recovery.frames_lost:
        lines.append(f"  {recovery.frames_lost} frames whose reference or whose scans are lost")
    if recovery.is_cut:
        lines.append("  the end, however much that was: it is cut off or damaged")
    if not recovery.knows_origin:
        lines.append("  the beginning: replay it with --sensor and --description")
    return lines
