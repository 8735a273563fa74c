"""`tactomo calibrate`: a sensor's pressure scale, from what a load cell says.

The daemon is asked to look again for what its sensor keeps, where it looks at its start; what it
finds may be another file than the one just kept, so what it says that it goes by is compared.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.table import Table
from tactomo_client import CalibrationInForce, CalibrationRefused, ClientError, Daemon, KeysError
from tactomo_client.control import to_status

from tactomo.cli import options
from tactomo.cli.console import Console
from tactomo.cli.output import say, table
from tactomo.cli.plot.plot import picture_option, save_figure
from tactomo.cli.sensors import SensorError, find_commanded, find_sensor, name_of, newest_status
from tactomo.plain import plain

if TYPE_CHECKING:
    from tactomo_models.calibration.calibration_file import (
        Kept,
        KeptFiles,
        Made,
        PressureCalibration,
    )

ROWS = 9  # of the table

app = options.typer_app(
    name="calibrate",
    help=(
        "Measure this sensor's curve from changes of the magnitude channel to pressure.\n\n"
        "Press with a flat indenter of known size on a load cell (or a scale, or weights): ten "
        "presses or more, each held still, from below the sensor's onset to the hardest press "
        "that you expect, and back. The command fits a rising curve with its uncertainty. Below "
        "the onset and beyond the last reading, contacts have a range instead of a "
        "pressure.\n\n"
        "The calibration belongs to the sensor's name and devices. A running daemon of the sensor "
        "uses the calibration at once, another daemon from its next start. A service keeps its "
        "own: `sudo -u tactomo STATE_DIRECTORY=/var/lib/tactomo/NAME tactomo calibrate ... "
        '--sensor NAME`, or `calibration = "FILE"` in its configuration.'
    ),
    no_args_is_help=True,
    epilog=options.examples(
        "tactomo calibrate live --sensor left_forearm --diameter-mm 30",
        "tactomo calibrate fit load_cell.csv --recording presses.mcap",
        "tactomo calibrate show --sensor left_forearm --picture curve.png",
    ),
)

DiameterMm = Annotated[
    float | None,
    typer.Option("--diameter-mm", min=1.0, max=1e3, help="Diameter of a round, flat indenter."),
]
AreaMm2 = Annotated[
    float | None,
    typer.Option("--area-mm2", min=1.0, max=1e6, help="Area of an indenter of another shape."),
]
Picture = Annotated[Path | None, picture_option("Draw readings and curve")]


@app.command(
    epilog=options.examples(
        "tactomo calibrate live", "tactomo calibrate live --sensor left_forearm --diameter-mm 30"
    )
)
def live(
    sensor: options.Sensor = None,
    diameter_mm: DiameterMm = None,
    area_mm2: AreaMm2 = None,
    output: options.KeptFile = None,
    address: options.Address = None,
    keys: options.KeysFolder = None,
) -> None:
    """Calibrate press by press with the running daemon, which guides you.

    The command says what to press, waits until the contact is still, asks for the load cell's
    reading, and says when there are enough readings. Ctrl-C keeps the readings; the same command
    continues later, until you delete the file of readings that it names.
    """
    from tactomo_models.calibration.calibration_file import CALIBRATIONS

    from tactomo.cli.calibrate.live import guided

    found = find_sensor(sensor, address, keys)
    status = to_status(newest_status(found.sensor, address, keys))
    path = output or CALIBRATIONS.path(found.sensor)
    area = _area_mm2(diameter_mm, area_mm2)
    made = guided(status, found.stream, keys, area, path)
    print_calibration(made)
    keep(CALIBRATIONS, made, path, address, keys)


@app.command(
    epilog=options.examples(
        "tactomo calibrate fit load_cell.csv --recording presses.mcap",
        "tactomo calibrate fit magnitudes.csv --dry-run --picture curve.png",
    )
)
def fit(
    readings: Annotated[
        Path, typer.Argument(metavar="FILE.csv", help="The load cell's log (columns above).")
    ],
    sensor: options.Sensor = None,
    recording: Annotated[
        Path | None,
        typer.Option(metavar="FILE.mcap", help="The sensor's recording of the same time."),
    ] = None,
    diameter_mm: DiameterMm = None,
    area_mm2: AreaMm2 = None,
    time_offset: Annotated[
        float, typer.Option(metavar="SECONDS", help="Added to the load cell's times.")
    ] = 0.0,
    description: options.GivenDescription = None,
    device_id: options.DeviceIds = None,
    picture: Picture = None,
    output: options.KeptFile = None,
    dry_run: options.DryRun = False,
    keep_odd: Annotated[
        bool, typer.Option("--keep-odd", help="Keep lines that the other lines contradict.")
    ] = False,
    address: options.Address = None,
    keys: options.KeysFolder = None,
) -> None:
    """Fit a table of readings.

    The table has column names: `pressure_kpa`, or `force_n` with `area_mm2` or `diameter_mm` of the
    indenter; and `magnitude` (|Δσ|/σ₀), optionally with `magnitude_sigma`. With --recording, a time
    replaces `magnitude`: `time_s` from the recording's beginning, or `realtime_s` since 1970 (UTC).
    `direction` (up, down) is optional; by default, the order gives the direction. A log of many
    lines a second is cut into pieces of constant load. The command names lines that contradict the
    others, and keeps nothing until you correct them or pass --keep-odd.
    """
    if not math.isfinite(time_offset):
        raise typer.BadParameter(f"--time-offset {time_offset}: give seconds")
    area = _area_mm2(diameter_mm, area_mm2)
    from tactomo_models.calibration.calibration_file import CALIBRATIONS

    from tactomo.cli.calibrate.live import fitted

    name = name_of(sensor)
    path = output or CALIBRATIONS.path(name)
    made, odd = fitted(
        name, readings, recording, area, time_offset, description, tuple(device_id or ())
    )
    print_calibration(made)
    is_refused = bool(odd) and not keep_odd
    if not (dry_run or is_refused):
        keep(CALIBRATIONS, made, path, address, keys)
    _draw(made, picture)
    if is_refused and not dry_run:
        from tactomo_models import CalibrationError

        # One slip moves the whole curve, and a running robot would go by it at once.
        raise CalibrationError(
            f"nothing is kept, as lines of {readings} disagree: {'; '.join(odd)}. Correct "
            "or leave out these lines and run the command again; or pass --keep-odd"
        )


@app.command(
    epilog=options.examples(
        "tactomo calibrate show --sensor left_forearm",
        "tactomo calibrate show curve.json --picture curve.png",
    )
)
def show(
    file: options.ShownFile = None,
    sensor: options.Sensor = None,
    picture: Picture = None,
) -> None:
    """Show a sensor's calibration: curve, uncertainty and readings."""
    from tactomo_models.calibration.calibration_file import CALIBRATIONS

    name = name_of(sensor)
    made = CALIBRATIONS.read(file or CALIBRATIONS.path(name), CALIBRATIONS.again(name))
    print_calibration(made)
    _draw(made, picture)


@app.command(epilog=options.examples("tactomo calibrate reload --sensor left_forearm"))
def reload(
    sensor: options.Sensor = None,
    address: options.Address = None,
    keys: options.KeysFolder = None,
) -> None:
    """Make the running daemon read its calibration file again."""
    there = find_commanded(sensor, address, keys)
    found = _reloaded(there.control, keys)
    say(f"in force now: the daemon of {there.sensor} goes by {_words(found)}")


def _area_mm2(diameter_mm: float | None, area_mm2: float | None) -> float | None:
    if diameter_mm is None:
        return area_mm2
    if area_mm2 is not None:
        raise typer.BadParameter("give either --diameter-mm or --area-mm2")
    return math.pi / 4 * diameter_mm**2


def _draw(made: PressureCalibration, picture: Path | None) -> None:
    if picture is not None:
        draw_calibration(made, picture)
        say(f"wrote {picture}")


def print_calibration(made: PressureCalibration) -> None:
    """Print a calibration: what it rests on, and the curve with its uncertainty."""
    console = Console()
    console.print(f"{made.subject.sensor}: {made.words}", soft_wrap=True, highlight=False)
    console.print(_table(made))
    console.print("; ".join(_facts(made)) + ".", soft_wrap=True, highlight=False)
    low, high = made.curve.range_kpa
    console.print(
        f"Below {low:.0f} kPa contacts are `below` (touched, pressure unknown); beyond {high:.0f} "
        "kPa they are `above` (a lower bound).",
        soft_wrap=True,
        highlight=False,
    )


def _table(made: PressureCalibration) -> Table:
    import numpy as np

    curve, shown = made.curve, table("|Δσ|/σ₀", "kPa", "± kPa")
    for kpa in np.linspace(*curve.range_kpa, ROWS):
        magnitude = np.interp(kpa, curve.pressure_kpa, curve.magnitude)
        shown.add_row(f"{magnitude:.3f}", f"{kpa:.0f}", f"{float(curve.sigma(magnitude)):.1f}")
    return shown


def _facts(made: PressureCalibration) -> list[str]:
    onset = made.onset_kpa
    hysteresis = made.hysteresis_kpa
    return [
        "onset not measured: the lightest reading already shows a response"
        if onset is None
        else f"answers from {onset:.0f} kPa",
        f"readings scatter by {made.repeatability_kpa:.1f} kPa beyond their own uncertainty",
        "hysteresis not measured: loads only rose, or only fell"
        if hysteresis is None
        else f"falling loads read {hysteresis:+.1f} kPa against rising ones",
        f"of {', '.join(made.subject.device_ids) or 'any device'}, as {made.subject.description}",
    ]


MARKERS = {"up": "^", "down": "v", "unknown": "o"}
LABELS = {"up": "load rising", "down": "load falling", "unknown": "reading"}


def draw_calibration(made: PressureCalibration, output: Path) -> None:
    """Draw readings and curve; raise TactomoError where the picture cannot be written."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    axes: Any = figure.subplots()
    curve = made.curve
    low, high = curve.range_kpa
    right = 1.08 * max(reading.pressure_kpa for reading in made.readings)
    axes.axvspan(0, low, color="0.92", label="below: touched, pressure unknown")
    axes.axvspan(high, right, color="0.82", label=f"above: at least {high:.0f} kPa")
    axes.plot(curve.pressure_kpa, curve.magnitude, color="tab:blue", label="curve")
    axes.fill_betweenx(
        curve.magnitude,
        curve.pressure_kpa - curve.sigma_kpa,
        curve.pressure_kpa + curve.sigma_kpa,
        color="tab:blue",
        alpha=0.25,
        label="± its standard uncertainty",
    )
    for direction, marker in MARKERS.items():
        of = [reading for reading in made.readings if reading.direction == direction]
        if of:
            axes.errorbar(
                [reading.pressure_kpa for reading in of],
                [reading.magnitude for reading in of],
                yerr=[reading.magnitude_sigma for reading in of],
                fmt=marker,
                color="black",
                markerfacecolor="none",
                capsize=2,
                linewidth=0.8,
                label=LABELS[direction],
            )
    axes.set(xlim=(0, right), xlabel="pressure (kPa)", ylabel="|Δσ|/σ₀")
    axes.set_ylim(bottom=0)
    title = plain(f"{made.subject.sensor}: {made.words}")
    axes.set_title(title, fontsize=10, parse_math=False)
    axes.legend(fontsize=8, loc="upper left")
    axes.grid(alpha=0.3)
    save_figure(figure, output)


CONNECT_S: Final = 1.0  # how long to wait where nobody listens: there need not be a daemon


def keep(
    files: KeptFiles[Made], made: Made, path: Path, address: str | None, keys: Path | None
) -> None:
    """Write what was made into a file, and have its sensor's daemon go by it, if that runs."""
    files.save(made, path)
    say(f"kept in {path}")
    say(taken_up(files, made, path, address, keys))


def taken_up(
    files: KeptFiles[Made], made: Made, path: Path, address: str | None, keys: Path | None
) -> str:
    """Have the sensor's daemon, if it runs, use what was kept; say in words what became of it."""
    sensor = made.subject.sensor
    own = files.path(sensor)
    again = f"tactomo calibrate reload --sensor {sensor}"
    try:
        found = _reloaded(find_commanded(sensor, address, keys).control, keys)
    except CalibrationRefused as error:
        return f"not in force: the daemon of {sensor} refused it: {error}"
    except KeysError as error:
        return (
            f"not in force yet: {error.cause}. Have somebody who may command run {again}, or start "
            "the daemon anew"
        )
    except (ClientError, SensorError) as error:
        it = "It" if path.absolute() == own.absolute() else f"Copied to {own}, it"
        later = f"{it} is in force when the daemon of {sensor} starts next, or by: {again}"
        return f"not in force yet: {error.cause}. {later}"
    if _is_in_force(made, found):
        return f"in force now: the daemon of {sensor} goes by it"
    return (
        f"not in force: the daemon of {sensor} goes by {_words(found)}. It looks on its own "
        f"computer, in its own data folder, or where its configuration says: copy {path} there, "
        f"then {again}"
    )


def _reloaded(control: str, keys: Path | None) -> CalibrationInForce:
    with Daemon(control, keys=keys, connect_timeout_s=CONNECT_S) as daemon:
        return daemon.reload_calibration()


def _is_in_force(made: Kept, found: CalibrationInForce) -> bool:
    from tactomo_models.calibration.calibration_file import PressureCalibration

    if not isinstance(made, PressureCalibration):
        return found.taught is not None and found.taught.taken == made.taken
    its = found.calibration
    kept = (made.taken, len(made.readings), made.curve.range_kpa)
    return its is not None and (its.taken, its.readings, its.range_kpa) == kept


def _words(found: CalibrationInForce) -> str:
    curve, taught = found.calibration, found.taught
    words = "the description's table"
    if curve is not None:
        low, high = curve.range_kpa
        words = f"{curve.readings} readings of {curve.taken}, {low:.0f} to {high:.0f} kPa"
    return words if taught is None else f"{words}; {taught.presses} presses of {taught.taken}"
