"""What docs/see_and_keep.md does with a recording: its commands, as they stand there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from newcomer import Newcomer
from page import Page
from recorded_grasp import LAST_PRESSED, contacts_of, write_grasp
from whole_system import repository

PAGE = Page("docs/see_and_keep.md")


@pytest.fixture
def newcomer(tmp_path: Path) -> Iterator[Newcomer]:
    (tmp_path / "deploy").symlink_to(repository() / "deploy")
    with Newcomer(tmp_path) as newcomer:
        yield newcomer


def force_n(newcomer: Newcomer) -> float:
    """The force that the page's program prints, newtons."""
    (program,) = PAGE.blocks("python")
    return float(newcomer.python(program).split()[0])


@pytest.mark.slow
def test_what_is_done_with_a_recording(newcomer: Newcomer) -> None:
    write_grasp(newcomer.folder / "grasp.mcap")
    newcomer.follow(PAGE.commands()[4:])
    assert force_n(newcomer) == pytest.approx(contacts_of(LAST_PRESSED - 1)[0].force_n, abs=1)
