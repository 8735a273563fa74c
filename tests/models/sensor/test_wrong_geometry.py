"""What users get wrong in outlines, mounts and companions: what the tests of each do not hold."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from tactomo_models import DescriptionError, load_description
from tactomo_models.sensor.description_file import shipped_text

CORNERS = "[[-0.06, -0.06], [0.06, -0.06], [0.06, 0.06], [-0.06, 0.06]]"
SQUARE = "v {0} {0} 0\nv -{0} {0} 0\nv -{0} -{0} 0\nv {0} -{0} 0\n"
TEXTURE = "vt {0} {0}\nvt -{0} {0}\nvt -{0} -{0}\nvt {0} -{0}\n"
FACE = "f 1/1 2/2 3/3 4/4\n"
CELL = "[companion.cell]\ngain_n_per_unit = 1.0\nnoise_n = 0.1\nregion_m = "
PLANE = '[mount]\nframe = "a"\n[mount.plane]\nposition_m = '
SURFACE = '[mount]\nframe = "a"\n[mount.surface]\nfile = "surface.obj"\n'


def outlined(outline: str, holes: str = "[]") -> str:
    keys = f"outline_m = {outline}\nholes_m = {holes}\n"
    return re.sub(r"outline_m = .*?\n\]\n", keys, shipped_text("palm_l"), count=1, flags=re.S)


def scaled(text: str, factor: float) -> str:
    """The text with all corners and electrodes of a polygon in another unit."""
    pair = re.compile(r"\[(-?[\d.]+), (-?[\d.]+)\]")
    return pair.sub(lambda at: str([factor * float(each) for each in at.groups()]), text)


def with_tables(tables: str) -> str:
    return f"{shipped_text('palm_l')}\n{tables}\n"


@pytest.mark.parametrize(
    ("text", "surface", "said"),
    [
        (outlined(CORNERS.replace("0.06", "6e-5")), "", "should be 120 x 120 mm, multiply"),
        (scaled(shipped_text("palm_l"), 100), "", "12 x 12 m, and may be 3 m: in centimetres or"),
        (shipped_text("skin_round").replace("width_m = 0.", "width_m = 9."), "", "width_m and"),
        (shipped_text("palm_l").replace("= 0.006", "= 6e-6"), "", "6 mm are 0.006 m"),
        (shipped_text("palm_l").replace("= 0.006", "= 6.0"), "", "give a shorter one, in metres"),
        (outlined(CORNERS, f"[{CORNERS.replace('0.06', '0.1')}]"), "", "covers the whole sheet"),
        (outlined("[[0, 0], [1, 1]]"), "", "outline_m = [[0, 0], [1, 1]]: give at least 3 entries"),
        (with_tables(PLANE + "[0, 0, 120]"), "", "in millimetres? 120 mm are 0.12 m"),
        (
            with_tables(SURFACE),
            (SQUARE + TEXTURE).format(0.00006) + FACE,
            "multiply them (vt) by 1000",
        ),
        (with_tables(CELL.replace("0.1", "0") + CORNERS), "", "noise_n = 0: give a number greater"),
        (
            with_tables(CELL.replace("cell", '"Cell 1"') + CORNERS),
            "",
            "Cell 1: give a name of lower",
        ),
        (with_tables("[mount]\nframe = ''"), "", "mount.frame = '': give a name of letters"),
        (with_tables("[mount]\nplane = 1"), "", "mount.plane = 1: give a table, [mount.plane]"),
        (with_tables(f"{CELL}[[0.02, 0.02], [0.05, 0.02], [0.05, 0.05]]"), "", "off the sheet"),
        (
            with_tables(f"{CELL}[[-0.05, -0.05], [-0.01, -0.01], [-0.01, -0.05], [-0.05, -0.01]]"),
            "",
            "region_m crosses or touches itself",
        ),
    ],
)
def test_wrong_geometry_is_named_with_the_next_step(
    tmp_path: Path, text: str, surface: str, said: str
) -> None:
    (tmp_path / "surface.obj").write_text(surface)
    (tmp_path / "wrong.toml").write_text(text)
    with pytest.raises(DescriptionError) as caught:
        load_description(tmp_path / "wrong.toml")
    assert said in str(caught.value)
