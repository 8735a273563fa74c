"""`tactomo calibrate` and the daemon that runs already: a kept calibration is put in force.

The daemon is asked to look for its sensor's calibration again, where it looks at its start; what it
finds may be another file than the one just kept, so what it says that it goes by is compared.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from tactomo.errors import TactomoError

if TYPE_CHECKING:
    from tactomo_client.status import Calibration
    from tactomo_models.calibration.calibration_file import PressureCalibration


CONNECT_S: Final = 1.0
"""How long to wait where nobody listens: there need not be a daemon."""


class OtherSensorError(TactomoError):
    """The daemon at the address has another sensor."""

    name = "other_sensor"


def reload_kept(sensor: str, control: str, keys: Path | None) -> str:
    """Have the daemon of a sensor read its calibration again; returns in words what is in force.

    Raises:
        ClientError: it does not answer, refuses the calibration, or does not let us command.
        OtherSensorError: it is another sensor's daemon.
    """
    found = _reloaded(sensor, control, keys)
    if found is None:
        return f"the daemon of {sensor} found none: pressures are the description's"
    low, high = found.range_kpa
    return (
        f"in force now: the daemon of {sensor} goes by {found.readings} readings of "
        f"{found.taken[:10]}, {low:.0f} to {high:.0f} kPa"
    )


def taken_up(made: PressureCalibration, path: Path, control: str, keys: Path | None) -> str:
    """Have the daemon of its sensor, if it runs, go by a calibration that was kept in `path`.

    Returns in words what became of it, and what is to be done.
    """
    from tactomo_client import CalibrationRefused, ClientError, KeysError, NoAnswer
    from tactomo_models.calibration.calibration_file import calibration_path

    sensor = made.subject.sensor
    again = f"tactomo calibrate reload --sensor {sensor}"
    own = calibration_path(sensor)
    it = "It" if path.absolute() == own.absolute() else f"Copied to {own}, it"
    later = f"{it} is in force when the daemon of {sensor} starts next, or by: {again}"
    try:
        found = _reloaded(sensor, control, keys)
    except (NoAnswer, OtherSensorError) as error:
        return f"not in force yet: {error.cause}. {later} --control ADDRESS"
    except CalibrationRefused as error:
        return f"not in force: the daemon of {sensor} refused it: {error}"
    except KeysError as error:
        return (
            f"not in force yet: {error.cause}. Have somebody who may command run {again}, or start "
            "the daemon anew"
        )
    except ClientError as error:
        return f"not in force yet: {error.cause}. {later}"
    if found is not None and _is_same(found, made):
        return f"in force now: the daemon of {sensor} goes by it"
    other = "the description's table" if found is None else f"the one taken {found.taken}"
    return (
        f"not in force: the daemon of {sensor} goes by {other}. It looks on its own computer, in "
        f"its own data folder, or where its configuration says: copy {path} there, then {again}"
    )


def _reloaded(sensor: str, control: str, keys: Path | None) -> Calibration | None:
    """Ask a sensor's daemon to read its calibration again; returns the one in force, if any."""
    from tactomo_client import Daemon

    with Daemon(control, keys=keys, connect_timeout_s=CONNECT_S) as daemon:
        there = daemon.status().sensor
        if there != sensor:
            raise OtherSensorError(
                f"the daemon at {control} is that of {there}, not of {sensor}",
                f"give the address of that of {sensor} by --control",
            )
        return daemon.reload_calibration().calibration


def _is_same(found: Calibration, made: PressureCalibration) -> bool:
    its = (found.taken, found.readings, found.range_kpa)
    return its == (made.taken, len(made.readings), made.curve.range_kpa)
