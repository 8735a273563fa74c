"""`tactomo calibrate`, `tactomo teach` and the daemon that runs already: what is kept is used.

The daemon is asked to look for what its sensor keeps again, where it looks at its start; what it
finds may be another file than the one just kept, so what it says that it goes by is compared.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from tactomo.cli.output import say
from tactomo.cli.sensors import SensorError, find_commanded

if TYPE_CHECKING:
    from tactomo_client import CalibrationInForce
    from tactomo_models.calibration.calibration_file import Kept, KeptFiles, Made


CONNECT_S: Final = 1.0  # how long to wait where nobody listens: there need not be a daemon


def reload_kept(name: str | None, address: str | None, keys: Path | None) -> str:
    """Have the daemon of a sensor read its calibration again; return in words what is in force."""
    there = find_commanded(name, address, keys)
    found = _reloaded(there.control, keys)
    return f"in force now: the daemon of {there.sensor} goes by {_words(found)}"


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
    from tactomo_client import CalibrationRefused, ClientError, KeysError

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
    from tactomo_client import Daemon

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
