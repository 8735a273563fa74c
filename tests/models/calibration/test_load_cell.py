"""A load cell's log: columns, units and times, and what of it becomes a reading."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tactomo_models import CalibrationError
from tactomo_models.arrays import FloatArray
from tactomo_models.calibration.load_cell import (
    Seen,
    direct_readings,
    joined_readings,
    read_load_cell,
)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "log.csv"


def test_forces_become_pressures_by_the_indenter(log: Path) -> None:
    log.write_text("# by hand\nForce_N; diameter_mm; magnitude\n100; 20; 0.1\n\n50; 10; 0.2\n")
    cell = read_load_cell(log)
    assert cell.pressure_kpa == pytest.approx([318.31, 636.62], rel=1e-4)
    assert cell.lines.tolist() == [3, 5]
    (first, second) = direct_readings(cell).readings
    assert (first.magnitude, second.direction) == (0.1, "up")
    log.write_text("force_n,magnitude\n100,0.1\n-0.2,0\n")
    assert read_load_cell(log, area_mm2=1000).pressure_kpa.tolist() == [100, 0]
    log.write_text('"Force_N","magnitude, shown"\n"100","0.1"\n')
    with pytest.raises(CalibrationError, match="it has: force_n, magnitude, shown"):
        read_load_cell(log)
    log.write_text('"force_n","magnitude"\n"100",0.1\n"-0.2","0"\n')
    joined = direct_readings(read_load_cell(log, area_mm2=1000))
    assert len(joined.readings) == 1
    assert joined.notes == ("1 lines without a load left out",)


def test_what_is_told_is_taken(log: Path) -> None:
    log.write_text(
        "pressure_kpa\tmagnitude\tmagnitude_sigma\tdirection\n100\t0.1\t0.01\tdown\n120\t0.1\t0\tup\n"
    )
    first, second = direct_readings(read_load_cell(log)).readings
    assert (first.magnitude_sigma, first.direction, second.direction) == (0.01, "down", "up")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "holds no readings"),
        ("magnitude\n0.1\n", "no column pressure_kpa, and no force_n; it has: magnitude"),
        ("force_n,magnitude\n100,0.1\n", "no area_mm2 or diameter_mm"),
        ("pressure_kpa,magnitude\n100,much\n", "line 2: magnitude = 'much' is no number"),
        ("force_n,area_mm2,magnitude\n1e308,1,0.1\n", "force_n = '1e308' is out of range"),
        ("pressure_kpa,magnitude\n100,0.1\n100\n", "line 3 has 1 of 2 columns"),
        ("pressure_kpa,time_s\n100,2\n100,1\n", "line 3: time_s goes back"),
        ("pressure_kpa,magnitude,direction\n100,0.1,left\n", "is not up, down or unknown"),
        ("pressure_kpa,magnitude\n100,-0.1\n", "magnitude is below 0"),
        ("pressure_kpa,magnitude\n0.06,0.1\n0.27,0.4\n", "is 0.27 kPa; is it in MPa"),
        (
            "pressure_kpa,force_n,area_mm2,magnitude\n100,700,707,0.1\n0,0,707,0\n",
            "is 9.9 times pressure_kpa",
        ),
    ],
)
def test_a_bad_log_is_refused_with_the_line(log: Path, text: str, said: str) -> None:
    log.write_text(text)
    with pytest.raises(CalibrationError, match=said):
        direct_readings(read_load_cell(log))


def test_a_file_that_is_no_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="No such file"):
        read_load_cell(tmp_path / "absent.csv")
    (tmp_path / "binary.csv").write_bytes(bytes(range(256)))
    with pytest.raises(CalibrationError, match="is not text"):
        read_load_cell(tmp_path / "binary.csv")


def seen(end_s: float, load: FloatArray, contacts: int = 1) -> Seen:
    """Twenty frames a second; a contact where there is a load (kPa, at each)."""
    times_s = np.arange(0, end_s, 0.05)
    touched = load > 0
    return Seen(
        times_s=times_s,
        magnitude=np.where(touched, load * 1e-3, np.nan),
        magnitude_sigma=np.where(touched, 0.004, np.nan),
        contact_mm2=np.where(touched, 300.0, np.nan),
        contacts=np.where(touched, contacts, 0),
    )


def test_a_log_of_many_lines_a_second_is_cut_into_still_pieces(log: Path) -> None:
    """Five presses of 3 s: each is ramped for 1 s, held for 1.5 s, and let go."""
    times_s = np.arange(0, 15, 0.01)
    levels = np.array([100.0, 150.0, 200.0, 150.0, 100.0])
    course = np.interp(times_s % 3, [0, 1, 2.5, 2.6, 3], [0, 1, 1, 0, 0])
    load = course * levels[(times_s // 3).astype(int)]
    rows = "".join(f"{t:.2f},{p:.2f}\n" for t, p in zip(times_s, load, strict=True))
    log.write_text("time_s,pressure_kpa\n" + rows)
    shown = np.interp(np.arange(0, 15, 0.05), times_s, load)
    joined = joined_readings(read_load_cell(log), seen(15, shown))
    found = [(round(r.pressure_kpa), r.magnitude_sigma, r.direction) for r in joined.readings]
    assert [kpa for kpa, _, _ in found] == [100, 150, 200, 150, 100]
    assert {direction for _, _, direction in found} == {"up"}, "let go in between"
    for reading in joined.readings:
        assert reading.magnitude == pytest.approx(reading.pressure_kpa * 1e-3, rel=0.08)


def test_a_line_for_each_press_will_do(log: Path) -> None:
    log.write_text("time_s,pressure_kpa\n2,100\n6,150\n10,200\n14,170\n18,120\n")
    load = np.interp(np.arange(0, 20, 0.05), [0, 20], [0, 0])
    for at_s, kpa in ((2, 100), (6, 150), (10, 200), (14, 170)):
        load[int((at_s - 1) / 0.05) : int((at_s + 1) / 0.05)] = kpa
    joined = joined_readings(read_load_cell(log), seen(20, load))
    assert [r.magnitude for r in joined.readings] == pytest.approx([0.1, 0.15, 0.2, 0.17])
    assert [r.direction for r in joined.readings] == ["up", "up", "up", "down"]
    assert joined.notes == ("1 presses left out, such as line 6, 18.0 s: no contact",)


@pytest.mark.parametrize(
    ("contacts", "start_s", "said"),
    [
        (1, 100.0, r"line 2, 102.0 s: no frame; it runs from 0.0 to 20.0 s .* --time-offset"),
        (2, 0.0, "line 2, 2.0 s: 2 contacts"),
    ],
)
def test_presses_that_are_not_in_the_recording_are_told(
    log: Path, contacts: int, start_s: float, said: str
) -> None:
    log.write_text(f"time_s,pressure_kpa\n{start_s + 2},100\n{start_s + 6},150\n")
    with pytest.raises(CalibrationError, match=said):
        joined_readings(read_load_cell(log), seen(20, np.full(400, 100.0), contacts))


def test_nothing_held_still_is_told(log: Path) -> None:
    rows = "".join(f"{t:.2f},{100 + 50 * np.sin(9 * t):.2f}\n" for t in np.arange(0, 10, 0.05))
    log.write_text("time_s,pressure_kpa\n" + rows)
    with pytest.raises(CalibrationError, match="nothing was held still"):
        joined_readings(read_load_cell(log), seen(10, np.full(200, 100.0)))


def test_one_indenter_presses_one_area(log: Path) -> None:
    """Where a contact is shown too small its magnitude is too large; two indenters differ."""
    log.write_text(
        "pressure_kpa,area_mm2,magnitude,magnitude_sigma,contact_mm2\n"
        "100,300,0.10,0.01,300\n150,300,0.18,0.01,250\n200,300,0.16666667,0.01,360\n"
        "100,100,0.11,0.01,91\n150,100,0.15,0.01,100\n200,100,0.18181818,0.01,110\n"
        "120,700,0.30,0.01,500\n"
    )
    readings = direct_readings(read_load_cell(log)).readings
    magnitudes = [reading.magnitude for reading in readings]
    assert magnitudes == pytest.approx([0.1, 0.15, 0.2, 0.1001, 0.15, 0.2, 0.3])
    assert readings[0].magnitude_sigma == pytest.approx(0.005)
    assert readings[-1].magnitude_sigma == 0.01, "one reading does not tell what is typical"
