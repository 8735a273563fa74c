"""`tactomo calibrate`: a sensor's pressure, from what a load cell says."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tactomo.cli.app import (
    DEFAULT_CONTROL,
    DEFAULT_DESCRIPTION,
    DEFAULT_NAME,
    DEFAULT_STREAM,
    STEER,
    ControlAddress,
    KeysFolder,
    StreamAddress,
    app,
    examples,
)
from tactomo.cli.plot import prepare_picture

if TYPE_CHECKING:
    from rich.table import Table
    from tactomo_client import Frame
    from tactomo_models.calibration_file import PressureCalibration, Subject
    from tactomo_models.load_cell import Joined, LoadCell, Seen

ROWS = 9  # of the table


@app.command(
    rich_help_panel=STEER,
    epilog=examples(
        "tactomo calibrate left_forearm --live --diameter-mm 30",
        "tactomo calibrate left_forearm --readings load_cell.csv --recording presses.mcap",
        "tactomo calibrate left_forearm --readings magnitudes.csv --dry-run --picture curve.png",
        "tactomo calibrate left_forearm --show",
        "tactomo calibrate left_forearm --reload",
    ),
)
def calibrate(
    sensor: Annotated[str, typer.Argument(help="The sensor's name in the stream.")] = DEFAULT_NAME,
    live: Annotated[
        bool, typer.Option("--live", help="Be guided, press by press, with the running daemon.")
    ] = False,
    readings: Annotated[
        Path | None, typer.Option(metavar="FILE.csv", help="What the load cell said, see above.")
    ] = None,
    recording: Annotated[
        Path | None,
        typer.Option(metavar="FILE.mcap", help="With --readings: what the sensor said meanwhile."),
    ] = None,
    diameter_mm: Annotated[
        float | None,
        typer.Option("--diameter-mm", min=1.0, max=1e3, help="Of a round, flat indenter."),
    ] = None,
    area_mm2: Annotated[
        float | None, typer.Option("--area-mm2", min=1.0, max=1e6, help="Of one of another shape.")
    ] = None,
    time_offset: Annotated[
        float, typer.Option(metavar="SECONDS", help="Added to the load cell's times.")
    ] = 0.0,
    description: Annotated[
        str | None,
        typer.Option(
            "--description",
            "-d",
            help="What the sensor is made of, where neither a recording nor a daemon tells. "
            f"[{DEFAULT_DESCRIPTION}]",
        ),
    ] = None,
    device_id: Annotated[
        list[str] | None,
        typer.Option(help="The device that it was made with, where nothing else tells; repeat."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Draw readings and curve: .png, .svg or .pdf.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Keep it in this file. [where the daemon looks]"),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Keep nothing.")] = False,
    keep_odd: Annotated[
        bool, typer.Option("--keep-odd", help="Keep it with lines that the others contradict.")
    ] = False,
    show: Annotated[bool, typer.Option("--show", help="Show the one that is kept.")] = False,
    reload: Annotated[
        bool, typer.Option("--reload", help="Have the running daemon read the one it finds again.")
    ] = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="With --live: begin anew, not with what was taken.")
    ] = False,
    stream: StreamAddress = DEFAULT_STREAM,
    control: ControlAddress = DEFAULT_CONTROL,
    keys: KeysFolder = None,
) -> None:
    """Find out what pressure the magnitude channel's change means on this very sensor.

    Press with a flat indenter of known size on a load cell (or a scale, or weights), from lighter
    than the sensor answers to as hard as it will be pressed, and back again: ten presses or more,
    each held still. A rising curve is fitted to the readings, with its uncertainty; below its onset
    and beyond the last reading contacts say so instead of a pressure. It is kept by the sensor's
    name and devices. The sensor's daemon goes by it at once if it runs (at --control), else from
    its next start.

    **--live** says what to press, waits until the contact is still, asks what the load cell says,
    and tells when it is enough. Ctrl-C keeps what was taken; the same command goes on from there.

    **--readings** is a table with column names: `pressure_kpa`, or `force_n` with `area_mm2` or
    `diameter_mm` of the indenter; and `magnitude` (|Δσ|/σ₀), with `magnitude_sigma` if that is
    known, or, with --recording, the time: `time_s` from the recording's beginning, or `realtime_s`
    since 1970 (UTC). `direction` (up, down) may be told, else it follows from the order. A log of
    many lines a second will do: it is cut into pieces in which the load was still. Lines that the
    others contradict are named, and nothing is kept until they are mended (or --keep-odd is given).

    A service keeps its own: `sudo -u tactomo STATE_DIRECTORY=/var/lib/tactomo/NAME tactomo
    calibrate NAME ...`, or `calibration = "FILE"` in its configuration.
    """
    if [live, readings is not None, show, reload].count(True) != 1:
        raise typer.BadParameter("give one of --live, --readings, --show and --reload")
    if recording is not None and readings is None:
        raise typer.BadParameter("--recording goes with --readings")
    if diameter_mm is not None and area_mm2 is not None:
        raise typer.BadParameter("--diameter-mm and --area-mm2: give one of them")
    if not math.isfinite(time_offset):
        raise typer.BadParameter(f"--time-offset {time_offset}: give seconds")
    from tactomo_client.messages import check_sensor_name

    check_sensor_name(sensor)
    if reload:
        from tactomo.cli.calibrate_reload import reload_kept

        typer.echo(reload_kept(sensor, control, keys))
        return
    if picture is not None:
        prepare_picture(picture)
    area = area_mm2 if diameter_mm is None else math.pi / 4 * diameter_mm**2
    from tactomo_models.calibration_file import calibration_path, save_calibration

    path = output or calibration_path(sensor)
    odd: list[str] = []
    if show:
        made = _kept(sensor, path)
    elif live:
        from tactomo.cli.calibrate_live import guided

        made = guided(sensor, stream, keys, area, path, fresh=fresh)
    else:
        assert readings is not None
        ids = tuple(device_id or ())
        made, odd = _of_files(sensor, readings, recording, area, time_offset, description, ids)
    tell(made)
    is_refused = bool(odd) and not keep_odd
    if not (dry_run or show or is_refused):
        from tactomo.cli.calibrate_reload import taken_up

        save_calibration(made, path)
        typer.echo(f"kept in {path}")
        typer.echo(taken_up(made, path, control, keys))
    if picture is not None:
        from tactomo.cli.calibrate_picture import draw_calibration

        draw_calibration(made, picture)
        typer.echo(f"wrote {picture}")
    if is_refused and not dry_run:
        from tactomo_models import CalibrationError

        # One slip moves the whole curve, and a running robot would go by it at once.
        raise CalibrationError(
            f"nothing is kept, as lines of {readings} disagree: {'; '.join(odd)}. Correct them, or "
            "leave them out, and run this again; or keep it as it is by --keep-odd"
        )


def tell(made: PressureCalibration) -> None:
    """Print a calibration: what it rests on, and the curve with its uncertainty."""
    from rich.console import Console

    console = Console()
    console.print(f"{made.subject.sensor}: {made.words}", soft_wrap=True, highlight=False)
    console.print(_table(made))
    console.print("; ".join(_facts(made)) + ".", soft_wrap=True, highlight=False)
    console.print(_beyond(made), soft_wrap=True, highlight=False)


def _table(made: PressureCalibration) -> Table:
    import numpy as np
    from rich.table import Table

    curve = made.curve
    table = Table()
    for heading in ("|Δσ|/σ₀", "kPa", "± kPa"):
        table.add_column(heading, justify="right")
    for kpa in np.linspace(*curve.range_kpa, ROWS):
        magnitude = np.interp(kpa, curve.pressure_kpa, curve.magnitude)
        table.add_row(f"{magnitude:.3f}", f"{kpa:.0f}", f"{float(curve.sigma(magnitude)):.1f}")
    return table


def _facts(made: PressureCalibration) -> list[str]:
    onset = made.onset_kpa
    hysteresis = made.hysteresis_kpa
    return [
        "onset not seen: the lightest reading is answered to"
        if onset is None
        else f"answers from {onset:.0f} kPa",
        f"readings scatter by {made.repeatability_kpa:.1f} kPa beyond their own uncertainty",
        "hysteresis not measured: loads only rose, or only fell"
        if hysteresis is None
        else f"falling loads read {hysteresis:+.1f} kPa against rising ones",
        f"of {', '.join(made.subject.device_ids) or 'any device'}, as {made.subject.description}",
    ]


def _beyond(made: PressureCalibration) -> str:
    low, high = made.curve.range_kpa
    return (
        f"Below {low:.0f} kPa contacts are `below` (touched, pressure unknown); beyond {high:.0f} "
        f"kPa they are `above` (at least {high:.0f} kPa)."
    )


def _kept(sensor: str, path: Path) -> PressureCalibration:
    from tactomo_models import CalibrationError
    from tactomo_models.calibration_file import read_calibration

    try:
        return read_calibration(path)
    except FileNotFoundError as error:
        raise CalibrationError(
            f"there is no calibration {path}; run: tactomo calibrate {sensor} --live"
        ) from error


def _of_files(
    sensor: str,
    readings: Path,
    recording: Path | None,
    area_mm2: float | None,
    offset_s: float,
    description: str | None,
    device_ids: tuple[str, ...],
) -> tuple[PressureCalibration, list[str]]:
    """Fit what a load cell says, with the magnitudes in it or in a recording; and its odd lines."""
    from tactomo_models import load_description
    from tactomo_models.calibration_file import PressureCalibration, subject_of
    from tactomo_models.load_cell import direct_readings, read_load_cell

    cell = read_load_cell(readings, area_mm2)
    if recording is None:
        _need(cell, readings, "magnitude")
        subject = subject_of(sensor, load_description(description or DEFAULT_DESCRIPTION))
        joined = direct_readings(cell)
    else:
        _need(cell, readings, "time")
        subject, joined = _with_recording(sensor, cell, recording, offset_s, description)
    if device_ids:
        subject = subject.model_copy(update={"device_ids": device_ids})
    odd = _odd_lines(joined)
    for note in (*joined.notes, *(f"{line} disagrees with the others" for line in odd)):
        typer.echo(note, err=True)
    return PressureCalibration.of_readings(subject, joined.readings), odd


def _odd_lines(joined: Joined) -> list[str]:
    """Name the lines that the others contradict."""
    from tactomo_models.odd_readings import odd_readings

    odd = [(joined.lines[i], joined.readings[i]) for i in odd_readings(joined.readings)]
    return [
        f"line {line} ({reading.pressure_kpa:.0f} kPa, |Δσ|/σ₀ {reading.magnitude:.3f})"
        for line, reading in odd
    ]


def _need(cell: LoadCell, path: Path, what: str) -> None:
    from tactomo_models import CalibrationError

    if what == "magnitude" and not (cell.magnitude >= 0).any():
        raise CalibrationError(
            f"{path} tells times and no magnitude; give the recording of that time by --recording"
        )
    if what == "time" and not cell.clock:
        raise CalibrationError(
            f"{path} has no column time_s or realtime_s, by which to find its lines in the "
            "recording; leave --recording out if its magnitudes are to be taken"
        )


def _with_recording(
    sensor: str, cell: LoadCell, path: Path, offset_s: float, description: str | None
) -> tuple[Subject, Joined]:
    from dataclasses import replace

    from tactomo_client.recording import open_recording
    from tactomo_models import CalibrationError
    from tactomo_models.calibration_file import subject_of
    from tactomo_models.load_cell import joined_readings

    from tactomo.cli.recorded import recorded_frames

    recorded = open_recording(path).sensor
    if recorded and recorded != sensor:
        raise CalibrationError(
            f"{path} is a recording of {recorded}, not of {sensor}; run: tactomo calibrate "
            f"{recorded}"
        )
    with recorded_frames(path, description) as frames:
        if frames.description is None:
            raise CalibrationError(
                f"the sensor description that {path} was recorded with is not on this computer; "
                "give it by --description"
            )
        subject = subject_of(sensor, frames.description, _devices_in(path))
        shown = frames.shown(frames.moments("contacts"), "reading contacts")
        by_start = cell.clock == "time_s"
        seen = seen_of(
            [
                (m.time_s if by_start else m.frame.acquired_realtime_ns * 1e-9, m.frame)
                for m in shown
            ]
        )
    return subject, joined_readings(replace(cell, times_s=cell.times_s + offset_s), seen)


def _devices_in(path: Path) -> tuple[str, ...]:
    from tactomo_client.recording import open_recording as open_frames

    from tactomo.recording import open_recording

    (first, *_) = open_frames(path).files
    hellos = open_recording(first).summary.hellos
    return tuple(sorted({hello.device_id for hello in hellos}))


def seen_of(frames: Sequence[tuple[float, Frame]]) -> Seen:
    """What a sensor showed in frames with their times; untrustworthy ones are left out.

    Raises:
        CalibrationError: there is none to be trusted.
    """
    import numpy as np
    from tactomo_models import CalibrationError
    from tactomo_models.load_cell import Seen

    from tactomo.cli.calibrate_live import distrusted

    trusted = [(time_s, frame) for time_s, frame in frames if not distrusted(frame)]
    if not trusted:
        raise CalibrationError(
            f"none of the {len(frames)} frames can be trusted; `tactomo doctor` tells why"
        )
    single = [frame.contacts[0] if len(frame.contacts) == 1 else None for _, frame in trusted]
    return Seen(
        times_s=np.array([time_s for time_s, _ in trusted]),
        magnitude=np.array([_number(c.magnitude if c else None) for c in single]),
        magnitude_sigma=np.array([_number(c.magnitude_sigma if c else None) for c in single]),
        contacts=np.array([len(frame.contacts) for _, frame in trusted]),
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else value
