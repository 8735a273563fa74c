"""`tactomo models import`: what it cannot read is told."""

from __future__ import annotations

from pathlib import Path

import pytest
from fixture_types import Run


def test_a_file_of_another_kind_is_told(tactomo: Run, tmp_path: Path) -> None:
    for name in ("scans.csv", "sensor.toml", "photo.png"):
        (tmp_path / name).write_text("0,1\n")
        result = tactomo("models", "import", name, "sheet.toml", status=1)
        assert f"{name} is of no kind that is read; give a .dxf, .svg, .mat or" in result.stderr
    assert not (tmp_path / "sheet.toml").exists()


@pytest.mark.parametrize("corners", ["0,0 100,100 0,100 100,0", "0,0 100,100 0,90 100,0"])
def test_an_outline_that_crosses_itself_is_told(tactomo: Run, tmp_path: Path, corners: str) -> None:
    (tmp_path / "bow.svg").write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="100mm" height="100mm" '
        f'viewBox="0 0 100 100"><polygon points="{corners}"/></svg>'
    )
    options = ("--count", "16", "--electrode-mm", "5")
    result = tactomo("models", "import", "bow.svg", "bow.toml", *options, status=1)
    assert "crosses itself" in result.stderr
