"""`tactomo teach`: where a skin is pressed, learnt from presses at known places."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tactomo.cli import options
from tactomo.cli.calibrate.calibrate import keep
from tactomo.cli.output import progress_bar, say
from tactomo.cli.sensors import find_sensor, name_of

if TYPE_CHECKING:
    from tactomo_models import SensorDescription
    from tactomo_models.calibration.calibration_file import Subject
    from tactomo_models.calibration.taught_skin import TaughtSkin

app = options.typer_app(
    name="teach",
    help=(
        "Correct this skin's localisation by presses at known places.\n\n"
        "With a robot, a plotter or a template, press 20 to 800 known places, spread over the "
        "skin, one at a time. A cross-validation on quarters of the presses compares the learnt "
        "model with the physics, and the better one is kept; likewise for forces, where known. "
        "A single contact is then `taught`: the model gives its place. A press unlike all taught "
        "presses has the flag `untaught`.\n\n"
        "The model belongs to the sensor's name and devices. A running daemon of the sensor uses "
        "the model at once, another daemon from its next start. A service keeps its own: see "
        "`tactomo calibrate --help`."
    ),
    no_args_is_help=True,
    epilog=options.examples(
        "tactomo teach live --sensor left_forearm",
        "tactomo teach fit presses.npz --sensor left_forearm",
        "tactomo teach show --sensor left_forearm",
    ),
)

KeepOdd = Annotated[
    bool, typer.Option("--keep-odd", help="Keep presses that the other presses contradict.")
]


@app.command(
    epilog=options.examples("tactomo teach live", "tactomo teach live --sensor left_forearm")
)
def live(
    sensor: options.Sensor = None,
    description: options.GivenDescription = None,
    output: options.KeptFile = None,
    keep_odd: KeepOdd = False,
    address: options.Address = None,
    keys: options.KeysFolder = None,
) -> None:
    """Teach press by press with the running daemon, which guides you.

    The command says where to press, listens for a second while you hold the press, and learns at
    the end. Each press is stored at once, in a file beside the taught model; the same command
    continues later.
    """
    from tactomo_models.calibration.taught_skin import TAUGHT

    from tactomo.cli.calibrate.teach_live import guided

    found = find_sensor(sensor, address, keys)
    path = output or TAUGHT.path(found.sensor)
    file = path.with_name(f"{found.sensor}.presses.npz")
    sensor_description, subject = guided(found.sensor, found.stream, keys, description, file)
    _teach(file, sensor_description, subject, path, address, keys, keep_odd=keep_odd)


@app.command(
    epilog=options.examples(
        "tactomo teach fit presses.npz --sensor left_forearm",
        "tactomo teach fit presses.npz --dry-run -d my_skin.toml",
    )
)
def fit(
    presses: Annotated[Path, typer.Argument(metavar="FILE.npz", help="Presses (format above).")],
    sensor: options.Sensor = None,
    description: options.Description = options.DEFAULT_DESCRIPTION,
    device_id: options.DeviceIds = None,
    output: options.KeptFile = None,
    dry_run: options.DryRun = False,
    keep_odd: KeepOdd = False,
    address: options.Address = None,
    keys: options.KeysFolder = None,
) -> None:
    """Learn from a file of presses.

    FILE holds the arrays of `tactomo reconstruct`, a row for each press in order of time:
    `magnitude` and `structure` (P, M) in volts, and `magnitude_reference`, `structure_reference`
    (M,) of the unpressed skin. `xy_mm` (P, 2) holds the place of each press: x to the right and y
    up from the middle of the skin, seen from the pressed side. `force_n` (P,) is optional: the
    force of each press in newtons, NaN where unknown. The command names presses that contradict the
    others, and keeps nothing until you correct them or pass --keep-odd.
    """
    from tactomo_models import load_description
    from tactomo_models.calibration.calibration_file import Subject
    from tactomo_models.calibration.taught_skin import TAUGHT

    known, name = load_description(description), name_of(sensor)
    subject = Subject.of(name, known, device_id or ())
    path = None if dry_run else output or TAUGHT.path(name)
    _teach(presses, known, subject, path, address, keys, keep_odd=keep_odd)


@app.command(epilog=options.examples("tactomo teach show --sensor left_forearm"))
def show(
    file: options.ShownFile = None,
    sensor: options.Sensor = None,
) -> None:
    """Show a skin's taught model: its presses and its errors."""
    from tactomo_models.calibration.taught_skin import TAUGHT

    name = name_of(sensor)
    _print(TAUGHT.read(file or TAUGHT.path(name), TAUGHT.again(name)))


def _teach(
    presses: Path,
    description: SensorDescription,
    subject: Subject,
    path: Path | None,
    address: str | None,
    keys: Path | None,
    *,
    keep_odd: bool,
) -> None:
    """Learn from a file, keep what is learnt in `path`, if any, and have the daemon use it."""
    from tactomo_models.calibration.taught_skin import TAUGHT
    from tactomo_models.commissioning.teach import read_presses, teach

    with progress_bar("reconstructing presses") as show:
        known = read_presses(presses, description)
        taught, notes = teach(known, description, subject, keep_odd=keep_odd, progress=show)
    for note in notes:
        say(note, err=True)
    _print(taught)
    if path is not None:
        keep(TAUGHT, taught, path, address, keys)


def _print(taught: TaughtSkin) -> None:
    subject = taught.subject
    say(f"{subject.sensor}: {taught.words}")
    how = "from the voltages alone" if taught.guess_mm is None else "as a correction of the physics"
    devices = ", ".join(subject.device_ids) or "any device"
    say(f"learnt {how}; of {devices}, as {subject.description}")
