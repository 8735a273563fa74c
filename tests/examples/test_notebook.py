"""The notebook: each of its cells runs, in order, and nothing that they print is kept in git."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import matplotlib.pyplot as plt
import pytest
from whole_system import repository

NOTEBOOK = repository() / "examples" / "first_steps.ipynb"


@pytest.fixture(scope="module")
def cells() -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    return [cell for cell in found if cell["cell_type"] == "code"]


@pytest.fixture(autouse=True)
def _pictures_in_memory() -> Iterator[None]:
    before = plt.get_backend()
    plt.switch_backend("agg")
    yield
    plt.close("all")
    plt.switch_backend(before)


def test_outputs_are_left_out(cells: list[dict[str, Any]]) -> None:
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in cells)
    assert NOTEBOOK.stat().st_size < 200_000


@pytest.mark.slow
def test_every_cell_runs(cells: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {"__name__": "__main__"}
    pictures = 0
    for number, cell in enumerate(cells):
        source = "".join(cell["source"])
        exec(compile(source, f"{NOTEBOOK.name}, cell {number}", "exec"), names)
        if "plt.subplots" in source:  # Jupyter shows what a cell leaves open, and closes it
            assert plt.get_fignums(), f"cell {number} shows no picture"
            pictures += 1
        for shown in map(plt.figure, plt.get_fignums()):
            shown.canvas.draw()
        plt.close("all")
    assert pictures == 4
    assert names["frame"].tier == "Brightest"
    assert capsys.readouterr().out.count(" kPa\n") == 2
