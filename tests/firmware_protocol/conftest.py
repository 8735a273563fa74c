"""The C library as it is built for a robot, for sanitizers, and for another byte order."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from c_firmware import SANITIZED, Speaker, build, runs, speaking
from needs import lacking, need


@pytest.fixture(scope="session")
def sanitized(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Speaker]:
    """The library under address and undefined behaviour sanitizers."""
    folder = tmp_path_factory.mktemp("sanitized")
    need("cc")
    if not runs(folder, "cc", SANITIZED):
        lacking("needs a compiler with sanitizers")
    with speaking(build("speak", folder, CFLAGS=SANITIZED)) as speaker:
        yield speaker


@pytest.fixture(scope="session")
def big_endian(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Speaker]:
    """The library on a 32-bit machine whose high bytes come first, emulated."""
    need("qemu-ppc", "powerpc-linux-gnu-gcc")
    folder = tmp_path_factory.mktemp("big_endian")
    program = build("speak", folder, "powerpc-linux-gnu-gcc", LDFLAGS="-static")
    with speaking(program, ["qemu-ppc"]) as speaker:
        yield speaker


@pytest.fixture(params=["sanitized", "big_endian"])
def speaker(request: pytest.FixtureRequest) -> Speaker:
    """The library, each way that it is built."""
    found: Speaker = request.getfixturevalue(request.param)
    return found
