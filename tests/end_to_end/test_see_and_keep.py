"""What docs/see_and_keep.md does with a recording: its commands, as they stand there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from newcomer import Newcomer
from page import Page
from recorded_grasp import LAST_PRESSED, contacts_of, write_grasp
from tactomo.cli.files.export import CONTACT_COLUMNS, FRAME_COLUMNS
from tactomo_foxglove.topics import FRAME_SCHEMA
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


def test_every_column_and_field_is_on_the_page() -> None:
    for name in FRAME_COLUMNS:
        assert f"`{name}`" in PAGE.text, name
    assert CONTACT_COLUMNS[:2] == ("id", "x_mm")
    for name in FRAME_SCHEMA["properties"]:
        assert f"`{name}`" in PAGE.text, name
