"""The example at the end of STREAM.md, run as it stands there, with pyzmq and msgpack alone."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from page import Page
from tactomo_client import Contact
from tactomo_client.fake import FakeSensor

HEAVY = Contact(4, 12.34, -56.7, 812.4, 0.2, 0.01, 183.2)
LIGHT = Contact(5, -1.0, 2.0, 300.0, None, None, None)


def example() -> str:
    (script,) = Page("clients/STREAM.md").blocks("python", "A complete client")
    return script


@pytest.fixture
def script(sensor: FakeSensor, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    path = tmp_path / "contacts.py"
    path.write_text(example(), "utf-8")
    process = subprocess.Popen(
        [sys.executable, "-I", path, "left", sensor.address], stdout=subprocess.PIPE, text=True
    )
    yield process
    process.kill()
    process.communicate()


def test_it_uses_nothing_else() -> None:
    assert set(re.findall(r"^import (\w+)", example(), re.M)) == {"msgpack", "sys", "time", "zmq"}
    assert "from " not in re.sub(r'""".*?"""', "", example(), flags=re.S).replace("from_", "")


def test_it_prints_contacts_and_tells_stale_from_nothing_pressed(
    sensor: FakeSensor, script: subprocess.Popen[str]
) -> None:
    assert script.stdout is not None

    def answer() -> str:
        """Return the next line that is not about silence."""
        assert script.stdout is not None
        for line in script.stdout:
            if not line.startswith("no frame of left for 0.5 s"):
                return line.strip()
        raise AssertionError("the script has ended")

    def publish(*contacts: Contact, flags: Sequence[str] = ()) -> None:
        """Publish a frame of a time to come: not old by the time at which it is read."""
        ahead_ns = time.monotonic_ns() + 10**12
        sensor.publish(contacts, flags=flags, acquired_monotonic_ns=ahead_ns)

    assert sensor.wait_for_subscriber(60) == b"left/contacts\0"
    publish(HEAVY, LIGHT, flags=["misfit_high"])
    assert answer() == "contact 4 at x=12.3 mm y=-56.7 mm, 812 mm2, 183 kPa misfit_high"
    assert answer() == "contact 5 at x=-1.0 mm y=2.0 mm, 300 mm2, pressure unknown misfit_high"
    publish()
    assert answer() == "nothing pressed"
    publish(flags=["electrode_fault"])
    assert answer() == "nothing pressed electrode_fault"
    publish(flags=["electrode_fault", "no_usable_scan"])
    assert answer() == "not known electrode_fault no_usable_scan"
    sensor.publish([], acquired_monotonic_ns=time.monotonic_ns() - 10**10)
    assert answer() == "stale"
    assert "is the daemon running?" in script.stdout.readline()
