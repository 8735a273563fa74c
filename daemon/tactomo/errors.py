"""What can go wrong in the daemon and its tools, each with a name, a cause and a next step.

They are raised for what a user can cause. A program shows `cause` and `next_step` and exits with
status 1; a traceback is for a mistake of ours.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class TactomoError(Exception):
    """Base of everything that tactomo raises on purpose."""

    name = "tactomo_error"

    def __init__(self, cause: str, next_step: str = "", name: str | None = None) -> None:
        super().__init__(f"{cause}; {next_step}" if next_step else cause)
        # a short stable identifier such as ``port_busy``, for programs
        self.name = name or type(self).name
        self.cause = cause  # what went wrong, for people
        self.next_step = next_step  # what to do about it, for people; may be empty


@contextmanager
def needs(what: str, install: str) -> Iterator[None]:
    """Raise TactomoError, which says how to install it, where a block lacks what it imports."""
    try:
        yield
    except ImportError as error:
        step = f"{install}, or `make setup` in a checkout" if "'tactomo[" in install else install
        raise TactomoError(f"{what} needs {error.name}, which is not installed", step) from error


@contextmanager
def os_errors_as(
    kind: Callable[[str, str], Exception], cause: str, next_step: str
) -> Iterator[None]:
    """Raise `kind` where the operating system refuses what a block does, with its reason."""
    try:
        yield
    except OSError as error:
        raise kind(f"{cause}: {error.strerror or error}", next_step) from error


class ConfigError(TactomoError):
    """The configuration cannot be used."""

    name = "bad_config"


class PortError(TactomoError):
    """A serial port cannot be used."""

    name = "port_unusable"


class PortAbsentError(PortError):
    """A serial port is not there."""

    name = "port_absent"


class PortBusyError(PortError):
    """A serial port is held by another process."""

    name = "port_busy"


class AddressError(TactomoError):
    """A socket cannot be bound."""

    name = "address_unusable"


class CommandError(TactomoError):
    """A control command was refused."""

    name = "refused"


class RecordingError(TactomoError):
    """A recording cannot be written or read."""

    name = "bad_recording"


class ServiceError(TactomoError):
    """The service cannot be installed, removed or asked."""

    name = "service_unusable"


def explain(error: BaseException) -> str | None:
    """Return what to print for the user about an error, or None if it is a mistake of ours.

    Every package of ours has one class from which its deliberate errors derive. Only packages that
    are loaded already can have raised one, so none is imported to find out.
    """
    for module, name in (
        ("tactomo.errors", "TactomoError"),
        ("tactomo_client.errors", "ClientError"),
        ("tactomo_models.errors", "ModelError"),
    ):
        kind = getattr(sys.modules.get(module), name, None)
        if kind is not None and isinstance(error, kind):
            return str(error)
    # What the system refuses is no mistake of ours: a path, a disk that is full or that fails.
    if isinstance(error, OSError) and error.strerror:
        name = error.filename
        what = "read or write" if name is None else f"use {os.fsdecode(name)}"
        return f"cannot {what}: {error.strerror}; check the path, and the disk that it is on"
    return None
