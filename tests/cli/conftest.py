"""The command line as a user runs it: arguments, output and an exit status."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fake_control import FakeControl
from tactomo.running import Running, announced


@pytest.fixture
def control() -> Iterator[FakeControl]:
    """The control socket of the only sensor that runs on this computer."""
    with FakeControl() as server, announced(Running("daemon", server.address, "left_forearm")):
        yield server
