"""The site that `make docs` builds: whole, and of nothing that comes from elsewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from whole_system import repository

pytest.importorskip("furo", reason="needs what `make docs` installs")
pytestmark = pytest.mark.slow  # 12 s of one core


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of this version, beside an older one."""
    folder = tmp_path_factory.mktemp("docs")
    (folder / "0.0.9").mkdir()
    (folder / "0.0.9" / "index.html").write_text("old")
    site = folder / metadata.version("tactomo")
    ready = tmp_path_factory.mktemp("env")
    command = ["make", "docs", "-o", f"{ready}/.ready-docs", f"VENV={ready}", f"SITE={site}"]
    command += [f"BIN={Path(sys.executable).parent}"]
    done = subprocess.run(command, cwd=repository(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return site


def test_nothing_is_fetched_from_elsewhere(site: Path) -> None:
    loaded = r'<(?:script|img|link)\b[^>]*\b(?:src|href)="(?:https?:)?//[^"]*"'
    pages = list(site.rglob("*.html"))
    assert len(pages) > 20
    for page in pages:
        assert not re.findall(loaded, page.read_text("utf-8")), page
    for style in site.rglob("*.css"):
        assert not re.findall(r"url\((?:https?:)?//[^)]*\)", style.read_text("utf-8")), style


def test_versions_lie_beside_each_other(site: Path) -> None:
    listed = re.findall(r'href="([^"]+)"', (site.parent / "index.html").read_text("utf-8"))
    assert listed == ["0.0.9/index.html", f"{site.name}/index.html"]
    page = (site / "docs" / "python.html").read_text("utf-8")
    assert 'href="../../index.html"' in page


def test_what_programs_import_is_in_the_reference(site: Path) -> None:
    page = (site / "docs" / "reference" / "tactomo_client.html").read_text("utf-8")
    assert 'id="tactomo_client.subscribe"' in page
    assert 'id="tactomo_client.Frame.is_known"' in page
    assert 'id="tactomo_client.recording.open_recording"' in page
