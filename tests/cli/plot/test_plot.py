"""`tactomo plot`: a page of a recording, and what is told about it."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import matplotlib.image as mpl_image
import numpy as np
import pytest
from fixture_types import Run
from recorded_grasp import (
    FIRST_PRESSED,
    FRAMES,
    LAST_PRESSED,
    LIGHT_FROM,
    PERIOD_NS,
    contacts_of,
    write_grasp,
)
from tactomo.cli.files.recorded_frames import recorded_frames
from tactomo.cli.plot.course import read_course, read_maps, telling_moments
from tactomo.cli.plot.page import draw_page


@pytest.fixture
def grasp(tmp_path: Path) -> Path:
    return write_grasp(tmp_path / "grasp.mcap", [n for n in range(FRAMES) if n not in (55, 56)])


def axes_labels(figure: Any) -> list[str]:
    return [axes.get_ylabel() for axes in figure.axes]


@pytest.mark.parametrize(
    ("name", "times", "shows"),
    [
        ("page.png", (), "2 contacts in 78 frames, 4.0 s"),
        ("page.svg", ("--from", 1, "--to", 2), "1 contact in 20 frames, 1.0 s"),
        pytest.param("page.pdf", (), "2 contacts in 78 frames, 4.0 s", marks=pytest.mark.slow),
    ],
)
def test_a_page_of_each_kind_and_of_some_seconds(
    tactomo: Run, grasp: Path, name: str, times: tuple[object, ...], shows: str
) -> None:
    result = tactomo("plot", grasp, "-o", name, *times, status=0)
    assert result.stdout == f"wrote {name}: {shows}\n"
    data = grasp.with_name(name).read_bytes()
    assert data.startswith({"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[name[-3:]])
    if name.endswith("png"):
        pixels = mpl_image.imread(grasp.with_name(name))
        assert pixels.shape[1] == 1500
        assert np.ptp(pixels[..., :3]) > 0.9


def test_what_the_page_is_drawn_from(grasp: Path) -> None:
    with recorded_frames(grasp, None) as frames:
        course = read_course(frames)
        maps = read_maps(frames, course)
        assert frames.description is not None
        figure = draw_page(course, maps, frames.description, "a grasp")
    assert list(course.tracks) == ["1", "2"]
    assert len(course.tracks["1"]) == LAST_PRESSED - FIRST_PRESSED - 2
    assert course.tracks["2"][0][0] == pytest.approx(LIGHT_FROM * PERIOD_NS * 1e-9)
    assert sum(course.lost) == 2
    assert course.ages_s[0] == pytest.approx(0.007)
    assert len(maps) == 6
    assert all(moment.frame.map is not None for moment in maps)
    labels = axes_labels(figure)
    assert {"pressure (kPa)", "force (N)", "misfit", "ms", "y (mm)"} <= set(labels)


def drawn(grasp: Path, label: str) -> Any:
    """The panel whose axis is called that."""
    with recorded_frames(grasp, None) as frames:
        course = read_course(frames)
        figure = draw_page(course, read_maps(frames, course), frames.description, "")
    return figure.axes[axes_labels(figure).index(label)]


def test_scans_that_were_not_reconstructed_are_not_called_nothing_lost(tmp_path: Path) -> None:
    kept = range(0, FRAMES, 2)
    path = write_grasp(tmp_path / "a.mcap", kept, lambda n: {"sequence": n // 2})
    words = drawn(path, "ms").get_title(loc="right")
    assert words.startswith("10.0 frames/s")
    assert words.endswith("0 frames lost, 39 dual scans left out")


@pytest.mark.parametrize("what", ["pressure (kPa)", "force (N)"])
def test_a_lower_bound_is_on_no_line(tmp_path: Path, what: str) -> None:
    def change(number: int) -> dict[str, Any]:
        of = "above" if number == 30 else "within"
        contacts = [replace(c, pressure_range=of, force_n=90.0) for c in contacts_of(30)]
        return {"contacts": [asdict(c) for c in contacts]}

    axes = drawn(write_grasp(tmp_path / "a.mcap", change=change), what)
    (marks,) = [line for line in axes.lines if line.get_marker() == "^"]
    (at_s,) = marks.get_xdata()
    lines = [line for line in axes.lines if line.get_linestyle() == "-"]
    assert not [y for line in lines for x, y in line.get_xydata() if x == at_s and y == y]


@pytest.mark.parametrize(
    ("arguments", "status", "says"),
    [
        (["grasp.mcap", "-o", "page.gif"], 1, "not a kind of picture"),
        (["grasp.mcap", "-o", "new/page.png"], 1, "there is no folder new"),
        (["grasp.mcap", "--from", "100"], 1, "no frames"),
        (["none.mcap"], 1, "none.mcap"),
    ],
)
@pytest.mark.usefixtures("grasp")
def test_what_goes_wrong_is_told(
    tactomo: Run, arguments: list[str], status: int, says: str
) -> None:
    result = tactomo("plot", *arguments, status=status)
    assert says in result.stderr.replace("\n", " ")


def test_a_sensor_without_magnitude_shows_areas(grasp: Path) -> None:
    with recorded_frames(grasp, None) as frames:
        course = read_course(frames)
        maps = read_maps(frames, course)
    for track in course.tracks.values():
        unknown: Any = dict.fromkeys(("magnitude", "pressure_kpa", "force_n"))
        track[:] = [(t, replace(c, **unknown, pressure_range="unknown")) for t, c in track]
    figure = draw_page(course, maps, None, "a tank")
    assert "area (mm²)" in axes_labels(figure)
    assert "force (N)" not in axes_labels(figure)


def moments_of(*stretches: tuple[int, str]) -> list[str]:
    """Return what is pressed at the telling moments of stretches of (frames, contacts)."""
    pressed = [frozenset(names) for frames, names in stretches for _ in range(frames)]
    times = [0.1 * i for i in range(len(pressed))]
    return ["".join(sorted(pressed[i])) for i in telling_moments(times, pressed, 4)]


def test_every_long_stretch_with_the_same_contacts_gets_a_map() -> None:
    assert moments_of((20, ""), (10, "a"), (10, "ab"), (10, "b")) in (
        ["a", "a", "ab", "b"],
        ["a", "ab", "ab", "b"],
        ["a", "ab", "b", "b"],
    )
    assert moments_of((40, "a"), (9, "b"), (8, "c"), (7, "d"), (6, "e")) == ["a", "b", "c", "d"]
    assert moments_of((50, ""), (1, "a")) == ["a"]
    assert moments_of((50, "")) == [""]
    assert moments_of((2, "a"), (1, "")) == ["a", "a"]
