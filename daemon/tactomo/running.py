"""Which daemons and twins run on this computer: each keeps a file that says where it serves.

The file is locked as long as its process lives, so that what a killed one leaves counts for
nothing. A service's file is in its runtime folder, which its group may read; that of a program that
somebody starts is in that user's own.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Literal

SERVICES: Final = Path("/run/tactomo")  # a folder for each service, see deploy/systemd
SUFFIX: Final = ".running.json"


@dataclass(frozen=True)
class Running:
    """Where a program serves."""

    kind: Literal["daemon", "twin"]
    control: str  # address of its control socket
    sensor: str = ""  # a daemon's
    stream: str = ""  # a daemon's
    ports: tuple[str, ...] = ()


@contextlib.contextmanager
def announced(program: Running) -> Iterator[None]:
    """Have others on this computer find a program while the block lasts.

    Where no file can be kept for that, they need its addresses.
    """
    with contextlib.ExitStack() as undo:
        with contextlib.suppress(OSError):
            folder = _own_folder()
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            for left in folder.glob(f"*{SUFFIX}"):
                if _read(left) is None:
                    left.unlink(missing_ok=True)
            number, name = tempfile.mkstemp(dir=folder)
            undo.callback(os.close, number)
            fcntl.flock(number, fcntl.LOCK_EX)
            os.fchmod(number, 0o640)
            os.write(number, json.dumps(asdict(program)).encode())
            file = Path(name).rename(f"{name}{SUFFIX}")  # complete and locked when it is seen
            undo.callback(file.unlink, missing_ok=True)
        yield


def running(kind: Literal["daemon", "twin"]) -> list[Running]:
    """Return the programs that run, and that this user may know of."""
    own = _own_folder()
    is_own = own.is_dir() and own.stat().st_uid == os.getuid()  # the name may be another user's
    folders = [*([own] if is_own else ()), *(SERVICES.glob("*") if SERVICES.is_dir() else ())]
    found = []
    for folder in folders:
        with contextlib.suppress(OSError):
            files = sorted(folder.glob(f"*{SUFFIX}"), key=lambda file: file.stat().st_mtime)
            found += [each for file in files if (each := _read(file)) and each.kind == kind]
    return found


def _own_folder() -> Path:
    service, session = map(os.environ.get, ("RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR"))
    if service:
        return Path(service)
    own = Path(session or f"/run/user/{os.getuid()}")
    return (
        own / "tactomo" if own.is_dir() else Path(tempfile.gettempdir(), f"tactomo-{os.getuid()}")
    )


def _read(file: Path) -> Running | None:
    """Return what a file says; None where its process has ended."""
    with contextlib.suppress(OSError, ValueError, TypeError), file.open("rb") as opened:
        try:
            fcntl.flock(opened, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            fields = json.load(opened)
            return Running(**{**fields, "ports": tuple(fields["ports"])})
    return None
