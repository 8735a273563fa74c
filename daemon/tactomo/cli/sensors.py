"""Which sensor a command is for: the one that is named, at the address given, or all that runs."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from tactomo.cli.options import DEFAULT_NAME
from tactomo.errors import TactomoError
from tactomo.running import Running, running

if TYPE_CHECKING:
    from tactomo_client import Keys
    from tactomo_client.connection import Connection

ALL_S: Final = 1.2  # so long, and every sensor of a stream has been heard


class SensorError(TactomoError):
    """No sensor, or several, may be meant."""

    name = "which_sensor"


@contextmanager
def of_this_version() -> Iterator[None]:
    """A block that reads what a daemon told.

    Raises TactomoError where another program, or another version, told it of other types.
    """
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise TactomoError(
            f"what answers is no daemon of this version: its messages have other values ({error})",
            "see them by `tactomo status --json`; install the version of that daemon",
        ) from error


def find_sensor(name: str | None, address: str | None, keys: Path | None = None) -> Running:
    """Return the sensor that is meant: the only one there is, where it is not named.

    Without an `address` of a stream, those that run on this computer count. Raises SensorError
    where none or several may be meant, and KeysError where the server lets nobody in by `keys`.
    """
    if address is not None:
        return _heard_of(name, address, keys)
    there = running("daemon")
    meant = [each for each in there if name in (None, each.sensor)]
    if len(meant) == 1:
        return meant[0]
    if meant:
        raise _several([(each.sensor, each.stream, ", ".join(each.ports)) for each in meant])
    others = ", ".join(each.sensor for each in there)
    raise SensorError(
        f"no sensor{'' if name is None else f' {name!r}'} runs on this computer"
        + (f", but {others}" if others else ""),
        "start one by `tactomo daemon` or `tactomo demo`; give the stream of one elsewhere by "
        "--address",
    )


def find_commanded(name: str | None, address: str | None, keys: Path | None) -> Running:
    """Return the sensor that is meant, see `find_sensor`, whose control socket is its own."""
    found = find_sensor(name, address, keys)
    if address is None:
        return found
    from tactomo_client import request

    there = request("status", found.control, keys=keys).get("sensor")
    if there != found.sensor:
        raise SensorError(
            f"{found.control} is the control socket of {there}, not of {found.sensor}",
            "run the command on the computer of its daemon",
        )
    return found


def newest_status(
    name: str | None, address: str | None, keys: Path | None = None
) -> Mapping[str, Any]:
    """Return the status of the sensor that is meant, see `find_sensor`."""
    if address is not None:
        return _status_of(name, address, keys)
    control = find_sensor(name, None).control
    from tactomo_client import request

    return request("status", control, keys=keys)


def name_of(name: str | None) -> str:
    """Return the name of the sensor that is meant, be it running or not."""
    from tactomo_client.messages import check_sensor_name

    if name is not None:
        return check_sensor_name(name)
    return find_sensor(None, None).sensor if running("daemon") else DEFAULT_NAME


def find_twin(address: str | None) -> str:
    """Return the control address of the twin; raise SensorError where none or several run."""
    if address is not None:
        return address
    there = running("twin")
    if len(there) == 1:
        return there[0].control
    if there:
        raise _several([("a twin", each.control, ", ".join(each.ports)) for each in there])
    raise SensorError(
        "no twin runs on this computer", "start one by `tactomo demo` or `tactomo twin`"
    )


def twin_of(sensor: Running) -> str | None:
    """Return the control address of the twin that a sensor's ports are of, if they are one's."""
    ports = _real(sensor.ports)
    twins = (twin for twin in running("twin") if ports and ports <= _real(twin.ports))
    return next((twin.control for twin in twins), None)


def reader_of(ports: Iterable[str]) -> Running | None:
    """Return the daemon that reads one of a twin's ports, if one does."""
    asked = _real(ports)
    return next((each for each in running("daemon") if _real(each.ports) & asked), None)


def _real(ports: Iterable[str]) -> set[str]:
    return {os.path.realpath(port) for port in ports}


def _several(there: list[tuple[str, str, str]]) -> SensorError:
    listed = "".join(f"\n  {name} at {at}, of {ports}" for name, at, ports in there)
    names = {name for name, _, _ in there}
    by = "--sensor NAME" if len(names) == len(there) else "--address ADDRESS"
    return SensorError(f"{len(there)} run on this computer", f"choose one by {by}:{listed}")


def _heard_of(name: str | None, address: str, keys: Path | None) -> Running:
    """Return a sensor that a stream carries, by its status."""
    status = _status_of(name, address, keys)
    with of_this_version():
        ports = tuple(str(port.get("url")) for port in status.get("ports") or ())
    control = _from_here(str(status.get("control")), address)
    return Running("daemon", control, status["sensor"], address, ports)


def _status_of(name: str | None, address: str, keys: Path | None) -> Mapping[str, Any]:
    statuses = _statuses(name, address, keys)
    if not statuses:
        raise SensorError(
            f"no daemon answers at {address}" + ("" if name is None else f" for a sensor {name!r}"),
            "does the daemon run, and is this its stream? `tactomo status` lists the daemons of "
            "this computer",
        )
    if len(statuses) > 1:
        raise SensorError(
            f"{address} carries {', '.join(sorted(statuses))}", "choose one by --sensor NAME"
        )
    return next(iter(statuses.values()))


def _from_here(control: str, stream: str) -> str:
    """Return the address of a control socket as it is reached from where a stream is."""
    host, port = urlsplit(stream).hostname, control.rpartition(":")[2]
    return f"tcp://{host}:{port}" if host and control.startswith("tcp:") else control


def _statuses(name: str | None, address: str, keys: Path | None) -> Mapping[str, Mapping[str, Any]]:
    """Return the newest status of each sensor that a stream carries, or of the named one."""
    from tactomo_client.messages import STATUS, topic
    from tactomo_client.schema import STALE_AFTER_S

    heard: dict[str, Mapping[str, Any]] = {}
    with listening(address, [b"" if name is None else topic(name, STATUS)], keys) as connection:
        end_s = time.monotonic() + STALE_AFTER_S
        while (left_s := end_s - time.monotonic()) > 0 and not (name and heard):
            for message in connection.heard(min(left_s, 0.1)):
                if not heard:
                    end_s = min(end_s, time.monotonic() + ALL_S)
                if message.kind == STATUS:
                    heard[message.sensor] = message.fields
    return heard


@contextmanager
def listening(address: str, topics: list[bytes], keys: Keys | Path | None) -> Iterator[Connection]:
    """Subscribe to these topics of a stream while a block lasts."""
    import zmq
    from tactomo_client.connection import connect_subscriber
    from tactomo_client.keys import as_keys

    known = as_keys(keys)  # or raises, before there is a socket
    connection = connect_subscriber(
        zmq.Context.instance().socket(zmq.SUB), address, topics, keys=known
    )
    try:
        yield connection
    finally:
        connection.close()
