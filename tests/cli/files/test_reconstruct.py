"""`reconstruct`: a file of scans in, a file of maps and contacts out."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixture_types import Run
from tactomo.cli import app
from tactomo_models import Flag, Press, SkinSimulator, available_methods, load_description
from tactomo_models.calibration.calibration_file import CALIBRATIONS, PressureCalibration, Subject
from tactomo_models.calibration.curve import Reading
from tactomo_models.growing_arrays import GrowingArrays
from tactomo_protocol import Channel
from typer.testing import CliRunner


def write_scans(path: Path, *presses: Press | None, spacing_m: float | None = None) -> None:
    """A scan of each press, without noise, and the reference."""
    skin = SkinSimulator(load_description("paper_square"), spacing_m)
    taken = [skin.voltages([press] if press else []) for press in presses]
    empty = skin.voltages([])
    references = {f"{name}_reference": volts for name, volts in empty.items()}
    scans = {str(name): np.stack([volts[name] for volts in taken]) for name in empty}
    np.savez(path, **scans, **references)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_press_is_found_in_a_file(tactomo: Run, tmp_path: Path) -> None:
    write_scans(tmp_path / "in.npz", None, Press(x_m=-0.03, y_m=0.03, pressure_kpa=180.0))
    result = tactomo("reconstruct", "in.npz", "out.npz", status=0)
    assert "wrote out.npz: 2 frames\nno frame is flagged\n" in result.stdout
    assert re.search(r"1 +-30\.\d +\d\d\.\d .* (179|18[01]) ± \d kPa", result.stdout)
    with np.load(tmp_path / "out.npz") as maps:
        assert maps["map"].shape == (2, 51, 51)
        assert maps["contact_frame"].tolist() == [1]
        assert abs(maps["contact_x_mm"][0] + 30.0) < 3.0
        assert abs(maps["contact_y_mm"][0] - 30.0) < 3.0
        assert maps["contact_pressure_range"].tolist() == ["within"]
        assert maps["contact_pressure_kpa"][0] == pytest.approx(180, abs=10)
        assert 0 < maps["contact_pressure_sigma_kpa"][0] < 10
        force_n = 1e-3 * maps["contact_pressure_kpa"] * maps["contact_area_mm2"]
        np.testing.assert_allclose(maps["contact_force_n"], force_n)
        assert np.isfinite(maps["contact_force_sigma_n"]).all()
        assert maps["contact_max_kpa"] > maps["contact_peak_kpa"] >= maps["contact_pressure_kpa"]
        assert maps["contact_peak_sigma_kpa"].shape == maps["contact_edge"].shape == (1,)
        assert maps["pressure_kpa"].dtype == np.float32
        np.testing.assert_array_equal(maps["pressure_kpa"][0], np.zeros((51, 51)))
        assert maps["pressure_kpa"][1].max() == pytest.approx(maps["contact_pressure_kpa"][0])


def test_scans_that_repeat_earlier_ones_are_left_out_and_told(tactomo: Run, tmp_path: Path) -> None:
    """As the daemon does, where scans at rest show that a converter at work has noise."""
    [volts] = SkinSimulator(load_description("tank_disc")).voltages([]).values()
    noise = 1e-4 * np.abs(volts).mean() * np.random.default_rng(0).normal(size=(30, len(volts)))
    rest, live = volts + noise[:20], volts + noise[20:]
    np.savez(
        tmp_path / "in.npz",
        allow_pickle=False,
        structure=np.vstack([live, np.repeat(live[-1:], 5, axis=0)]),
        structure_reference=rest,
    )
    result = tactomo("reconstruct", "in.npz", "out.npz", "-d", "tank_disc", status=0)
    assert "left out: 5 scans that repeat earlier ones" in result.stderr
    assert "5 of 15 frames are flagged no_usable_scan" in result.stdout
    with np.load(tmp_path / "out.npz") as maps:
        assert [bool(Flag(int(each)) & Flag.NO_USABLE_SCAN) for each in maps["flags"]] == (
            [False] * 10 + [True] * 5
        )


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["named", "plain"])
def test_companions_of_a_file_are_judged_in_every_layout(
    tactomo: Run, tmp_path: Path, layout: str
) -> None:
    tactomo("models", "copy", "graded_square", "cell.toml", status=0)
    with (tmp_path / "cell.toml").open("a") as file:
        file.write("[companion.cell]\ngain_n_per_unit = 2.0\nnoise_n = 0.1\n")
    skin = SkinSimulator(load_description(tmp_path / "cell.toml"))
    press = Press(x_m=0.03, y_m=0.03, pressure_kpa=180.0, radius_m=0.015)
    [force_n] = skin.forces_n([press]).values()
    [pressed], [empty] = skin.voltages([press]).values(), skin.voltages([]).values()
    noise = 1e-3 * np.abs(pressed - empty).max() * np.random.default_rng(0).normal(size=(23, 208))
    volts, rest = ("magnitude", "magnitude_reference") if layout == "named" else ("data", "vh")
    at_rest = 7.0
    arrays = {
        volts: pressed + noise[:3],
        rest: empty + noise[3:],
        "companion_cell": at_rest + np.array([force_n / 2, np.nan, 3 * force_n / 2]),
        "companion_cell_reference": at_rest,
    }
    np.savez(tmp_path / "in.npz", **arrays)
    tactomo("reconstruct", "in.npz", "out.npz", "-d", "cell.toml", status=0)
    with np.load(tmp_path / "out.npz") as maps:
        names = [Flag(int(flags)).names() for flags in maps["flags"]]
        assert names == [[], ["companion_missing"], ["companion_disputed"]]
        assert maps["force_n"][0] == pytest.approx(force_n, rel=0.02)
    arrays["companion_cel"] = arrays.pop("companion_cell")
    np.savez(tmp_path / "in.npz", **arrays)
    refused = tactomo("reconstruct", "in.npz", "out.npz", "-d", "cell.toml", status=1)
    assert "no companion for companion_cel; rename" in refused.stderr


@pytest.mark.slow
def test_a_calibration_says_how_hard_is_pressed(tactomo: Run, tmp_path: Path) -> None:
    sensor = load_description("paper_square")
    write_scans(tmp_path / "in.npz", Press(x_m=-0.03, y_m=0.03, pressure_kpa=180.0))
    readings = [
        Reading(pressure_kpa=kpa, magnitude=max(0.0, (kpa - 50) * 2e-3))
        for kpa in (20.0, 60.0, 80.0, 100.0, 130.0, 160.0)
    ]
    subject = Subject(sensor="left", description=sensor.name, sha256=sensor.sha256)
    made = PressureCalibration.of_readings(subject, readings)
    CALIBRATIONS.save(made, tmp_path / "left.pressure.json")
    options = ("--calibration", "left.pressure.json")
    tactomo("reconstruct", "in.npz", "out.npz", *options, status=0)
    with np.load(tmp_path / "out.npz") as maps:  # 180 kPa change it by 0.177
        assert maps["contact_pressure_kpa"][0] == pytest.approx(50 + 0.177 / 2e-3, abs=5)
    refused = tactomo("reconstruct", "in.npz", "out.npz", *options, "-d", "skin_round", status=1)
    assert "is of a sensor as paper_square describes it" in refused.stderr


@pytest.mark.slow
def test_every_method_can_be_asked_for(tmp_path: Path) -> None:
    write_scans(tmp_path / "in.npz", Press(x_m=0.03, y_m=-0.02, pressure_kpa=180.0))
    maps = {}
    for method in available_methods():
        source, target = tmp_path / "in.npz", tmp_path / f"{method}.npz"
        result = CliRunner().invoke(
            app, ["reconstruct", str(source), str(target), "--method", method]
        )
        assert result.exit_code == 0, result.output
        with np.load(target) as out:
            maps[method] = out["structure"][0]
            nearest = np.hypot(out["contact_x_mm"] - 30, out["contact_y_mm"] + 20).min()
            assert nearest < 5, method
            assert out["seconds"][0] > 0
    for method in set(available_methods()) - {"auto"}:
        others = (maps[other] for other in available_methods() if other not in ("auto", method))
        assert all((maps[method] != other).any() for other in others), "each has its own image"


@pytest.mark.slow
def test_bad_scans_are_flagged_in_the_file(tactomo: Run, tmp_path: Path) -> None:
    description = load_description("paper_square")
    skin = SkinSimulator(description, unevenness=0.03, seed=3)
    press = Press(x_m=-0.03, y_m=0.03, pressure_kpa=180.0)
    rng = np.random.default_rng(8)

    def noisy(volts: Any) -> Any:
        return volts + 1e-4 * np.abs(volts).max() * rng.standard_normal(volts.shape)

    pressed = {
        name: noisy(np.tile(volts, (6, 1))) for name, volts in skin.voltages([press]).items()
    }
    structure = pressed[Channel.STRUCTURE]
    structure[1, 7] = np.nan
    touched = (np.hstack([description.pairs.drive, description.pairs.measure]) == 5).any(axis=1)
    structure[2, touched] = 0.0
    structure[3] = np.clip(structure[3], -0.5 * np.abs(structure[3]).max(), None)
    structure[4] = 0.0
    structure[5] = 0.3 * rng.standard_normal(208)
    empty = {f"{name}_reference": noisy(volts) for name, volts in skin.voltages([]).items()}
    np.savez(tmp_path / "in.npz", **pressed, **empty)
    tactomo("reconstruct", "in.npz", "out.npz", status=0)
    with np.load(tmp_path / "out.npz") as maps:
        flags = [Flag(int(value)) for value in maps["flags"]]
    assert flags[0] == Flag(0)
    assert Flag.INVALID_VOLTAGE in flags[1]
    assert Flag.ELECTRODE_FAULT in flags[2]
    assert Flag.SATURATED in flags[3]
    assert Flag.STRUCTURE_MISSING | Flag.INVALID_VOLTAGE in flags[4]
    assert flags[5] & (Flag.NOISE_HIGH | Flag.STRUCTURE_MISSING)


@pytest.mark.parametrize(
    "methods", [("tikhonov,noser",), pytest.param(("tikhonov", "noser"), marks=pytest.mark.slow)]
)
def test_methods_are_drawn_side_by_side(
    tactomo: Run, tmp_path: Path, methods: tuple[str, ...]
) -> None:
    write_scans(tmp_path / "in.npz", None, None, spacing_m=0.008)
    named = [word for name in methods for word in ("--method", name)]
    result = tactomo("reconstruct", "in.npz", "out.npz", *named, "--picture", "maps.svg", status=0)
    assert "wrote maps.svg" in result.stdout
    drawn = (tmp_path / "maps.svg").read_text("utf-8")
    assert all(f"{name}, frame 1" in drawn for name in ("tikhonov", "noser"))


def test_only_its_own_output_is_written_over_unasked(tactomo: Run, tmp_path: Path) -> None:
    write_scans(tmp_path / "in.npz", None, None, spacing_m=0.008)
    scans = (tmp_path / "in.npz").read_bytes()
    command = ("reconstruct", "in.npz", "out.npz", "--method", "tikhonov")
    tactomo(*command, status=0)
    tactomo(*command, status=0)  # it can be computed again
    swapped = tactomo("reconstruct", "out.npz", "in.npz", status=1)
    assert "in.npz exists already" in swapped.stderr
    tactomo("reconstruct", "in.npz", "in.npz", "--force", status=2)
    assert (tmp_path / "in.npz").read_bytes() == scans
    tactomo("reconstruct", "in.npz", "new/out.npz", status=1)
    assert not (tmp_path / "new").exists()


def test_what_is_no_file_is_not_replaced_by_one(tactomo: Run, tmp_path: Path) -> None:
    write_scans(tmp_path / "in.npz", None, None, spacing_m=0.008)
    (tmp_path / "nothing").symlink_to("/dev/null")
    command = ("reconstruct", "in.npz", "nothing", "--method", "tikhonov")
    tactomo(*command, status=0)
    assert Path("/dev/null").is_char_device()
    assert (tmp_path / "nothing").is_symlink()


def test_half_a_file_is_never_left(
    tactomo: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_scans(tmp_path / "in.npz", None, None, spacing_m=0.008)

    def interrupted(_: object, file: Any, *__: Any) -> None:
        file.write(b"half of it")
        raise KeyboardInterrupt

    monkeypatch.setattr(GrowingArrays, "write", interrupted)
    assert tactomo("reconstruct", "in.npz", "out.npz", "--method", "tikhonov").returncode != 0
    assert [path.name for path in tmp_path.iterdir()] == ["in.npz"]
