"""Sheets of any outline, electrodes anywhere: what is accepted, what is refused and why."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tactomo_models import DescriptionError, SensorDescription, load_description
from tactomo_models.sensor.description_file import shipped_text
from tactomo_models.sensor.outline import Pad
from variants import variant

SQUARE = [[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]]
HOLE = [[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]]
ON_RIM = [[-0.02, -0.05], [0.02, -0.05], [0.05, 0.0], [0.02, 0.05], [-0.02, 0.05], [-0.05, 0.0]]


def polygon(
    sheet: dict[str, Any] | None = None, electrodes: dict[str, Any] | None = None
) -> dict[str, Any]:
    """A description's tables, of a square with six electrodes unless something else is given."""
    return {
        "schema": 1,
        "name": "some",
        "sheet": {
            "shape": "polygon",
            "outline_m": SQUARE,
            "conductivity_s_m": 1.0,
            "thickness_m": 1e-4,
            **(sheet or {}),
        },
        "electrodes": {
            "length_m": 0.006,
            "contact_impedance_ohm_m": 1.0,
            "positions_m": ON_RIM,
            **(electrodes or {}),
        },
        "pattern": {"current_a": 1e-3},
        "map": {"nodes_x": 31, "nodes_y": 31},
        "structure": {"conductivity_ratio": 10.0},
    }


def square(sheet: dict[str, Any] | None = None, **electrodes: Any) -> SensorDescription:
    return SensorDescription.model_validate(polygon(sheet, electrodes))


BOW_TIE = [[-0.05, -0.05], [0.05, 0.05], [0.05, -0.05], [-0.05, 0.05]]
CIRCLE = [
    [0.05 * np.cos(angle), 0.05 * np.sin(angle)] for angle in np.linspace(0, 2 * np.pi, 1500)[:-1]
]
SPIKE = [[-0.05, -0.05], [0.05, -0.05], [0.05, 0.0], [0.0, 0.001], [0.05, 0.002], [-0.05, 0.05]]


def list_of_one(corners: list[list[float]], x_m: float) -> list[list[list[float]]]:
    return [[[x + x_m, y] for x, y in corners]]


@pytest.mark.parametrize(
    ("sheet", "said"),
    [
        ({"outline_m": BOW_TIE}, r"outline_m crosses or touches itself at 0, 0.*walks round"),
        ({"outline_m": SQUARE[:2]}, r"outline_m"),
        ({"outline_m": [[0, 0], [0.01, 0], [0.02, 0]]}, r"outline_m.*(encloses no area|crosses)"),
        ({"outline_m": CIRCLE}, r"1499 points, more than 1000.*leave out"),
        ({"outline_m": [SQUARE[0], *SQUARE]}, r"outline_m\[1\] is the corner before it once more"),
        ({"outline_m": SPIKE}, r"outline_m\[3\] is a corner of .* degrees.*cut its tip off"),
        ({"outline_m": [[x + 0.05, y] for x, y in SQUARE]}, r"middle.*0.05, 0.*subtract"),
        ({"outline_m": [[50 * x * 100, y] for x, y in SQUARE]}, r"outline_m"),
        ({"outline_m": [[float("nan"), 0], *SQUARE]}, r"(?s)outline_m.*finite"),
        ({"outline_m": [[float("inf"), 0], *SQUARE]}, r"(?s)outline_m.*finite"),
        ({"holes_m": list_of_one(HOLE, 0.05)}, r"holes_m\[0\] touches outline_m"),
        ({"holes_m": list_of_one(HOLE, 0.5)}, r"holes_m\[0\] lies outside.*leave it out"),
        (
            {"holes_m": [[[-0.01, -0.06], [0.01, -0.06], [0.01, 0.06], [-0.01, 0.06]]]},
            r"holes_m\[0\] cuts the sheet in two.*sensor of its own",
        ),
        ({"width_m": 0.1}, r"width_m.*left out"),
        ({"shape": "disc", "width_m": 0.1}, r"a polygon takes outline_m"),
    ],
)
def test_an_outline_that_is_none_is_refused_by_name(sheet: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        square(sheet)


@pytest.mark.parametrize(
    ("electrodes", "said"),
    [
        ({"positions_m": [[0, 0], *ON_RIM]}, r"positions_m\[0\].* 50 mm inside.*pad_radius_m"),
        ({"positions_m": [[0, 0.07], *ON_RIM]}, r"positions_m\[0\].* 20 mm off.*onto the sheet"),
        ({"positions_m": [*ON_RIM, [0.021, -0.05]]}, r"positions_m\[1\] and \[6\] lie over"),
        (
            {"positions_m": [*ON_RIM, [0.0, 0.0], [0.004, 0.0]], "pad_radius_m": 0.003},
            r"positions_m\[6\] and \[7\] lie over each other.*pad_radius_m",
        ),
        (
            {"positions_m": [*ON_RIM, [0.0, 0.046]], "pad_radius_m": 0.005},
            r"positions_m\[6\].*pad of 5 mm has no room",
        ),
        ({"clockwise": True}, r"clockwise.*as positions_m lists"),
        ({"count": 8}, r"positions_m.*beside count"),
        ({"positions_m": None, "count": 8}, r"a polygon takes positions_m"),
    ],
)
def test_electrodes_that_lie_nowhere_are_refused_by_name(
    electrodes: dict[str, Any], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        square(None, **electrodes)


def test_a_list_in_millimetres_is_one_complaint_that_says_so(tmp_path: Path) -> None:
    file = tmp_path / "mm.toml"
    text = shipped_text("palm_l")
    file.write_text(text.replace("-0.06, -0.06", "-60, -60").replace("-0.06, 0.06", "-60, 60"))
    said = r"outline_m\.0\.0 = -60.*in millimetres\? -60 mm are -0.06 m \(and 3 more of this list\)"
    with pytest.raises(DescriptionError, match=said) as refused:
        load_description(file)
    assert str(refused.value).count("outline_m") == 1


def test_an_outline_counts_either_way_round() -> None:
    there, back = square(), square({"outline_m": SQUARE[::-1]})
    np.testing.assert_allclose(there.electrode_ends_m, back.electrode_ends_m)
    assert (there.on_sheet(*np.meshgrid(there.map_x_m, there.map_y_m))).all()


def test_a_place_next_to_the_rim_is_on_the_rim() -> None:
    off = square(positions_m=[[x * 1.02, y * 1.02] for x, y in ON_RIM])
    depth = off.sheet.outline.depth(*off.electrode_centres_m.T)
    assert np.abs(depth).max() < 1e-9


def test_electrodes_go_round_corners_and_holes() -> None:
    corner = square({"holes_m": [HOLE]}, positions_m=[[0.05, 0.05], [0, -0.01], *ON_RIM])
    (before, after), (left, right) = corner.electrode_ends_m[:2].round(9).tolist()
    assert (before, after) == ([0.05, 0.047], [0.047, 0.05])
    assert sorted([left, right]) == [[-0.003, -0.01], [0.003, -0.01]]
    assert corner.rim_order[1] == -1
    on_rim = np.delete(corner.rim_order, 1)
    assert ((on_rim - on_rim[1]) % 7).tolist() == [3, 0, 1, 2, 4, 5, 6]
    assert not corner.on_sheet(np.array([0.0]), np.array([0.0])).any()


def test_electrodes_inside_are_pads() -> None:
    pads = square(positions_m=[*ON_RIM, [0.0, 0.0]], pad_radius_m=0.003)
    assert [isinstance(each, Pad) for each in pads.placed_electrodes] == [False] * 6 + [True]
    assert pads.electrode_centres_m[6].tolist() == [0.0, 0.0]


def test_uneven_electrodes_on_a_rectangle_and_a_disc(paper: SensorDescription) -> None:
    places = [
        [-0.06, -0.075],
        [0.0, -0.075],
        [0.07, -0.075],
        [0.075, 0.0],
        [0.0, 0.075],
        [-0.075, 0],
    ]
    listed = {"length_m": 0.006, "contact_impedance_ohm_m": 10.0, "positions_m": places}
    uneven = variant(paper, electrodes={**listed, "per_side": None, "pitch_m": None})
    np.testing.assert_allclose(uneven.electrode_centres_m, places, atol=1e-12)
    assert set(np.diff(uneven.rim_order) % 6) == {1}
    raw = load_description("tank_disc").model_dump(by_alias=True, exclude_none=True)
    raw["electrodes"] = {
        **listed,
        "positions_m": [[0.1 * np.cos(a), 0.1 * np.sin(a)] for a in (0, 1, 1.5, 3, 4, 6)],
    }
    disc = SensorDescription.model_validate(raw)
    at = np.arctan2(*disc.electrode_centres_m.T[::-1]) % (2 * np.pi)
    np.testing.assert_allclose(at, (0, 1, 1.5, 3, 4, 6), atol=1e-9)


def test_clockwise_starts_at_the_same_electrode() -> None:
    raw = load_description("paper_square").model_dump(by_alias=True, exclude_none=True)
    there = SensorDescription.model_validate(raw).electrode_centres_m
    raw["electrodes"]["clockwise"] = True
    back = SensorDescription.model_validate(raw)
    np.testing.assert_array_equal(back.electrode_centres_m, there[[0, *range(15, 0, -1)]])
    assert back.sha256 != load_description("paper_square").sha256
