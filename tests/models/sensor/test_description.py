"""Sensor descriptions: the shipped ones, the order of a scan, and errors that say what to do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_sensor import SMALL
from tactomo_models import DescriptionError, SensorDescription, load_description
from tactomo_models.sensor.description_file import shipped_text
from tactomo_models.sensor.pattern import scan_pairs
from variants import variant


def structure_table(ratios: str) -> str:
    """A structure channel's table of conductivity ratios, as a description has it."""
    return f"[structure.response]\npressure_kpa = [0, 50, 100]\nconductivity_ratio = {ratios}"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            ("width_m = 0.06", "width_m = -1"),
            ["sheet.width_m", "-1", "greater than or equal to 0.00001"],
        ),
        (("conductivity_s_m = 1.0", "conductivity_s_m = -2.0"), ["= -2.0: give a number greater"]),
        (("width_m = 0.06", "width_m = 120"), ["in millimetres? 120 mm are 0.12 m"]),
        (("width_m = 0.06", 'width_m = "0.06"'), ["sheet.width_m", "'0.06'", "number"]),
        (("per_side = 2", "per_side = 2.5"), ["electrodes.per_side = 2.5", "integer"]),
        (("per_side = 2", "per_side = 2\ncount = 8"), ["electrodes", "no count"]),
        (("current_a = 1e-4", "current_a = 1e-4\ndrive_offset = 0"), ["pattern.drive_offset = 0"]),
        (
            ("thickness_m", "frame_width_m = 0.02\nthickness_m"),
            ["sheet.frame_width_m = 0.02", "0.0125"],
        ),
        (("[0.0, 100.0, 200.0]", "[0.0, 200.0, 100.0]"), ["pressure_kpa", "200.0, 100.0", "rise"]),
        (("[0.0, 100.0, 200.0]", "[1.0, 100.0, 200.0]"), ["pressure_kpa", "start at 0"]),
        (("[0.0, 100.0, 200.0]", "[0.0, 1e5, 2e5]"), ["in pascals? 200000 Pa are 200 kPa"]),
        (("0.0, 0.0, 0.25]", "0.0, 0.0, 0.0]"), ["relative_change", "only rise"]),
        (("[magnitude.response]", "[magnitude.reponse]"), ["unknown key magnitude.reponse"]),
        (("conductivity_ratio = 100.0", ""), ["structure.response or conductivity_ratio"]),
        (("ohm_m = 10.0", "ohm_m = 1e-12"), ["contact_impedance_ohm_m = 1e-12", "check the units"]),
        (("width_m = 0.06", ""), ["sheet.width_m is missing"]),
        (('"rectangle"', '"hexagon"'), ["sheet.shape", "hexagon", "'disc' or 'polygon'"]),
        (("height_m = 0.05", ""), ["height_m is required"]),
        (("length_m = 0.006", "length_m = 0.03"), ["length_m", "0.03", "below"]),
        (("pitch_m = 0.02", "pitch_m = 0.09"), ["pitch_m", "0.06", "two in brackets"]),
        (("per_side = 2", "per_side = [2, 17]"), ["electrodes.per_side.1 = 17", "equal to 16"]),
        (('"rectangle"\nwidth_m = 0.06\nheight_m = 0.05', '"disc"\nwidth_m = 0.06'), ["count"]),
        (("[pattern]", "[pattern]\ndrive = [[0, 8]]"), ["pattern.drive holds [0, 8]", "0 to 7"]),
        (("[pattern]", "[pattern]\ndrive = [[0, 4], [0, 4]]"), ["drive[1] = [0, 4]", "twice"]),
        (
            ("[pattern]", "[pattern]\ndrive = [[0, 1]]\ndrive_offset = 3"),
            ["drive and drive_offset", "one of the two"],
        ),
        (
            ("[pattern]", "[pattern]\ndrive = [[0, 1]]\nmeasure = [[1, 2]]"),
            ["0 voltages", "1 to 64"],
        ),
        (
            ("[pattern]", '[instrument]\nvoltages = "rms"\n[pattern]'),
            ["instrument.voltages", "unsigned"],
        ),
        (("0.0, 0.0, 0.25]", "0.0, 0.3, 0.25]"), ["relative_change", "only rise or only fall"]),
        (("0.0, 0.0, 0.25]", "0.0, 0.25]"), ["as many entries"]),
        (
            ("conductivity_ratio = 100.0", structure_table("[1.0, 30.0, 20.0]")),
            ["structure.response", "conductivity_ratio", "only rise or only fall"],
        ),
        (
            ("conductivity_ratio = 100.0", structure_table("[2.0, 30.0, 100.0]")),
            ["structure.response", "conductivity_ratio", "start at 1"],
        ),
        (
            ("conductivity_ratio = 100.0", structure_table("[1.0, 0.5, -0.1]")),
            ["structure.response.conductivity_ratio.2 = -0.1: give a number greater than 0"],
        ),
        (("conductivity_ratio = 100.0", "conductivity_ratio = 1.0"), ["differ from 1"]),
        (
            ("conductivity_ratio = 100.0", "conductivity_ratio = 0.01\neither_way = true"),
            ["structure.conductivity_ratio = 0.01", "above 1 with either_way"],
        ),
        (("schema = 1", "schema = 2"), ["schema", "2", "1"]),
        (('name = "small"', 'name = "Über Skin"'), ["name", "Über Skin"]),
        (("schema = 1", "schema = = 1"), ["not valid TOML"]),
    ],
)
def test_an_error_names_the_key_the_value_and_what_is_allowed(
    tmp_path: Path, change: tuple[str, str], said: list[str]
) -> None:
    assert change[0] in SMALL
    file = tmp_path / "sensor.toml"
    file.write_text(SMALL.replace(*change))
    with pytest.raises(DescriptionError) as caught:
        load_description(file)
    for part in ["sensor.toml", *said]:
        assert part in str(caught.value)


@pytest.mark.parametrize("content", [None, b"\xff\xfe\x00"])
def test_an_unreadable_file_is_named(tmp_path: Path, content: bytes | None) -> None:
    file = tmp_path / "missing.toml"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(DescriptionError, match=r"missing\.toml.*paper_square"):
        load_description(file)


def test_a_folder_and_an_unknown_name_are_named(tmp_path: Path) -> None:
    for source in (tmp_path, "paper_sqare"):
        with pytest.raises(
            DescriptionError, match=f"{source}.*paper_square.*skin_round.*tank_disc"
        ):
            load_description(source)


def test_every_complaint_is_made_at_once(tmp_path: Path) -> None:
    file = tmp_path / "sensor.toml"
    file.write_text(SMALL.replace("width_m", "widht_m").replace("current_a = 1e-4", ""))
    with pytest.raises(DescriptionError) as caught:
        load_description(file)
    said = str(caught.value)
    for key in ("sheet.width_m is missing", "unknown key sheet.widht_m", "pattern.current_a"):
        assert key in said


def test_an_error_repeats_no_more_than_a_line_of_what_a_file_says(tmp_path: Path) -> None:
    file, long = tmp_path / "sensor.toml", "k" * 100_000
    file.write_text(SMALL.replace('name = "small"', f'name = "{long}"\n{long} = 1'))
    with pytest.raises(DescriptionError) as caught:
        load_description(file)
    assert len(str(caught.value)) < 1000


def test_a_disc_takes_a_count_and_no_pitch(tmp_path: Path) -> None:
    text = shipped_text("tank_disc")
    file = tmp_path / "disc.toml"
    for key, wrong, said in [
        (
            "count = 16",
            "count = 16\npitch_m = 0.01",
            "a disc takes count, and no per_side or pitch_m",
        ),
        ("count = 16", "per_side = 4", "a disc takes count"),
        ("count = 16", "count = 5", "electrodes.count = 5"),
        ("count = 16", "count = 80", "electrodes.count = 80"),
        ("length_m = 0.008", "length_m = 0.05", r"electrodes.length_m = 0.05.*below.*0.03927"),
        ("width_m = 0.200", "width_m = 0.2\nheight_m = 0.1", r"sheet.height_m = 0.1.*left out"),
    ]:
        assert key in text
        file.write_text(text.replace(key, wrong))
        with pytest.raises(DescriptionError, match=said):
            load_description(file)


def test_electrodes_of_a_disc_go_counter_clockwise_from_the_bottom() -> None:
    centres_mm = load_description("tank_disc").electrode_centres_m * 1e3
    assert centres_mm[0] == pytest.approx([0, -100], abs=0.2)
    assert centres_mm[4] == pytest.approx([100, 0], abs=0.2)
    assert centres_mm[8] == pytest.approx([0, 100], abs=0.2)


def test_sides_may_have_electrodes_of_their_own(tmp_path: Path) -> None:
    file = tmp_path / "sensor.toml"
    unequal = SMALL.replace("per_side = 2", "per_side = [3, 1]")
    file.write_text(unequal.replace("pitch_m = 0.02", "pitch_m = [0.018, 0.01]"))
    sensor = load_description(file)
    assert sensor.electrode_count == 8
    assert (sensor.electrode_centres_m * 1e3).round(6).tolist() == [
        *([-18, -25], [0, -25], [18, -25], [30, 0]),
        *([18, 25], [0, 25], [-18, 25], [-30, 0]),
    ]


@given(st.integers(6, 32), st.integers(1, 31), st.integers(1, 31))
def test_a_scan_holds_every_pair_but_those_that_touch(
    electrodes: int, drive_offset: int, measure_offset: int
) -> None:
    drive_offset, measure_offset = drive_offset % electrodes or 1, measure_offset % electrodes or 1
    pairs = scan_pairs(electrodes, drive_offset, measure_offset)
    listed = list(zip(pairs.drive[:, 0].tolist(), pairs.measure[:, 0].tolist(), strict=True))
    wanted = [
        (k, m)
        for k in range(electrodes)
        for m in range(electrodes)
        if not {k, (k + drive_offset) % electrodes} & {m, (m + measure_offset) % electrodes}
    ]
    assert listed == wanted


@pytest.mark.parametrize(
    ("change", "rebuild"),
    [
        (("pitch_m = 0.02", "pitch_m = 0.021"), True),
        (("thickness_m", "frame_width_m = 0.001\nthickness_m"), True),
        (("[pattern]", "[pattern]\ndrive = [[0, 4], [1, 5]]"), True),
        (("[map]", '[instrument]\nvoltages = "unsigned"\n[map]'), False),
        (("nodes_x = 21", "nodes_x = 23"), True),
        (("width_m = 0.06", "width_m = 0.060"), False),
        (("0.0, 0.0, 0.25]", "0.0, 0.1, 0.25]"), False),
        (('name = "small"', 'title = "Skin"\nname = "small"'), False),
    ],
)
def test_the_hash_follows_the_physics_alone(
    tmp_path: Path, change: tuple[str, str], rebuild: bool
) -> None:
    assert change[0] in SMALL

    def hash_of(text: str) -> str:
        (tmp_path / "sensor.toml").write_text(text)
        return load_description(tmp_path / "sensor.toml").sha256

    changed = hash_of(SMALL.replace(*change))
    assert (changed != hash_of(SMALL)) == rebuild


@pytest.mark.parametrize(
    ("name", "digits"),
    [
        ("paper_square", "41544fbeee0e"),
        ("skin_round", "31d6be1fdd7e"),
        ("tank_disc", "9556eb0ce76d"),
        ("tank_uef2017", "e344dae4f17b"),
    ],
)
def test_what_shipped_keeps_its_hash(name: str, digits: str) -> None:
    """Networks and artifacts are bound to it: a new key must not change it where it is not used."""
    assert load_description(name).sha256.startswith(digits)


def test_listed_pairs_are_the_offsets_spelt_out(small: SensorDescription) -> None:
    opposite = variant(small, pattern={"drive_offset": 4})
    listed = variant(
        small,
        pattern={
            "drive": [[k, (k + 4) % 8] for k in range(8)],
            "measure": [[m, (m + 1) % 8] for m in range(8)],
        },
    )
    np.testing.assert_array_equal(listed.pairs.drive, opposite.pairs.drive)
    np.testing.assert_array_equal(listed.pairs.measure, opposite.pairs.measure)
    assert listed.offsets == opposite.offsets == (4, 1)
    assert str(opposite.pattern) == "drive (k, k+4), measure (m, m+1)"
    assert str(listed.pattern) == "drive 8 listed pairs, measure 8 listed pairs"


def test_descriptions_are_equal_by_what_they_say() -> None:
    """They serve as keys, also once arrays have been worked out from them."""
    one, other = load_description("paper_square"), load_description("paper_square")
    assert one is not other
    assert all(len(d.map_x_m) and len(d.electrode_ends_m) and d.sha256 for d in (one, other))
    assert one == other
    assert {one: "kept"}[other] == "kept"
    assert one != load_description("tank_disc")
    assert one != "paper_square"
