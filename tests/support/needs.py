"""What a test needs of the computer, beside the packages: skipped where that may be absent."""

from __future__ import annotations

import os
import shutil
from typing import NoReturn

import pytest


def lacking(what: str) -> NoReturn:
    """Skip the test; fail it where TACTOMO_TESTS_NEED_ALL is set, as `.ci/run` sets it."""
    if os.environ.get("TACTOMO_TESTS_NEED_ALL"):
        pytest.fail(f"{what}, and TACTOMO_TESTS_NEED_ALL is set: install it", pytrace=False)
    pytest.skip(what)


def need(*programs: str) -> None:
    """Skip the test where a program is missing, as `lacking` does."""
    for program in programs:
        if shutil.which(program) is None:
            lacking(f"needs {program} on the PATH")
