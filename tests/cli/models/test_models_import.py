"""`tactomo models import`: what it does not read is told by its kind."""

from __future__ import annotations

from pathlib import Path

from fixture_types import Run


def test_a_file_of_another_kind_is_told(tactomo: Run, tmp_path: Path) -> None:
    for name in ("scans.csv", "sensor.toml", "photo.png"):
        (tmp_path / name).write_text("0,1\n")
        result = tactomo("models", "import", name, "sheet.toml", status=1)
        assert f"{name} is of no kind that is read; give a .dxf, .svg, .mat or" in result.stderr
    assert not (tmp_path / "sheet.toml").exists()
