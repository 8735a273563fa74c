"""`info` of what is not a recording, and `models`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fixture_types import Run
from hostile_files import BAD_DEVICE, BAD_SENSOR, markup_recording
from scipy.io import savemat
from variants import rewritten


def test_info_of_a_shipped_description(tactomo: Run) -> None:
    facts = json.loads(tactomo("info", "paper_square", "--json").stdout)
    assert facts["electrodes"] == 16
    assert facts["voltages a scan"] == 208
    assert facts["channels"] == "magnitude, structure"


def test_a_sensor_of_too_many_voltages_is_told_before_it_is_wired(
    tactomo: Run, tmp_path: Path
) -> None:
    changes = ("count = 16", "count = 64"), ("drive_offset = 8", "drive_offset = 1")
    rewritten(
        tmp_path / "many.toml", "skin_round", *changes, ("length_m = 0.004", "length_m = 1e-3")
    )
    facts = json.loads(tactomo("info", "many.toml", "--json").stdout)
    assert facts["voltages a scan"] == "3904: of files alone, as a live scan has 1024 at most"


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("none.mcap", None, "cannot open the recording none.mcap"),
        ("text.mcap", "hello", "text.mcap is no recording that tactomo made"),
        ("bad.toml", "schema = 1\ncolour = 2", "unknown key colour"),
        ("nosuchsensor", None, "paper_square"),
    ],
)
def test_info_of_what_cannot_be_read(
    tactomo: Run, tmp_path: Path, name: str, content: str | None, says: str
) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    result = tactomo("info", name, status=1)
    assert says in result.stderr


def test_models_list(tactomo: Run) -> None:
    assert "paper_square" in tactomo("models", "list").stdout


def test_info_of_every_file_that_reconstruct_reads(tactomo: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("1,2,3\n4,5,6\n")
    facts = json.loads(tactomo("info", "a.csv", "--json").stdout)
    assert facts["arrays"] == {"numbers": "float64 (2, 3)"}
    savemat(tmp_path / "a.mat", {"vv": np.ones((2, 208))})
    facts = json.loads(tactomo("info", "a.mat", "--json").stdout)
    assert facts["arrays"] == {"vv": "float64 (2, 208)"}


def test_names_of_others_are_shown_as_they_are(tactomo: Run, tmp_path: Path) -> None:
    markup_recording(tmp_path / "a.mcap")
    result = tactomo("info", "a.mcap", status=0)
    for name in (BAD_DEVICE, BAD_SENSOR, "skin[left]"):
        assert name in result.stdout
    assert "\x1b]" not in result.stdout
