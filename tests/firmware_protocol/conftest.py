"""The C library as it is built for a robot, for sanitizers, and for another byte order."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from builds import runs
from c_firmware import CHECKED, Speaker, build, speaking
from needs import lacking, need


@pytest.fixture(scope="session")
def sanitized() -> Iterator[Speaker]:
    """The library under address and undefined behaviour sanitizers."""
    need("cc")
    if not runs("cc", CHECKED):
        lacking("needs a compiler with sanitizers")
    with speaking(build("speak", CFLAGS=CHECKED)) as speaker:
        yield speaker


@pytest.fixture(scope="session")
def big_endian() -> Iterator[Speaker]:
    """The library on a 32-bit machine whose high bytes come first, emulated."""
    need("qemu-ppc", "powerpc-linux-gnu-gcc")
    program = build("speak", "powerpc-linux-gnu-gcc", LDFLAGS="-static")
    with speaking(program, ["qemu-ppc"]) as speaker:
        yield speaker


@pytest.fixture(params=["sanitized", "big_endian"])
def speaker(request: pytest.FixtureRequest) -> Speaker:
    """The library, each way that it is built."""
    found: Speaker = request.getfixturevalue(request.param)
    return found
