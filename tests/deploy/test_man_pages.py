"""The manual pages of the Debian package: one for each command, of what its help says."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from whole_system import repository


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("man")
    script = repository() / "deploy/debian/man_pages.py"
    subprocess.run([sys.executable, script, made], check=True)
    return made


def test_every_command_has_its_page_and_every_option_is_on_it(folder: Path) -> None:
    pages = {path.name for path in folder.iterdir()}
    assert {"tactomo.1", "tactomo-daemon.1", "tactomo-models.1", "tactomo-models-build.1"} <= pages
    page = (folder / "tactomo-replay.1").read_text()
    for words in (r"\-\-speed", "as fast as reconstructed", "default: 1.0", "grasp.mcap"):
        assert words in page
    assert "`" not in page
    assert "tactomo-replay.1" in pages
    assert "Steer" not in (folder / "tactomo.1").read_text()  # panels are of the help alone
    for line in ("build", "list", "draw"):
        assert f".B {line}" in (folder / "tactomo-models.1").read_text()


@pytest.mark.skipif(shutil.which("groff") is None, reason="groff is not here")
def test_groff_has_nothing_to_say_against_them(folder: Path) -> None:
    for path in folder.iterdir():
        command = ["groff", "-man", "-Kutf8", "-Tutf8", "-ww", "-z", str(path)]
        outcome = subprocess.run(command, capture_output=True, text=True, check=True)
        assert outcome.stderr == "", path.name
