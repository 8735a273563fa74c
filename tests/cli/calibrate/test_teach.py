"""`tactomo teach`: a hand-made skin is located better, and bad presses are named and not kept."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixture_types import Run
from handmade_skin import presses, write_description
from tactomo_models.archive import read_arrays
from tactomo_models.calibration.taught_skin import TAUGHT

Arrays = dict[str, Any]


@pytest.fixture(scope="module")
def good() -> Arrays:
    return presses(60, seed=1)


def teach(tactomo: Run, folder: Path, arrays: Arrays, *options: str, status: int = 0) -> Any:
    np.savez(folder / "presses.npz", **arrays)
    sensor = write_description(folder / "skin.toml")
    command = ("teach", "fit", folder / "presses.npz", "--sensor", "palm", "-d", sensor)
    return tactomo(*command, *options, status=status)


def errors_mm(tactomo: Run, folder: Path, *options: Any) -> tuple[np.ndarray, dict[str, Any]]:
    """Of presses that nothing was taught by, on the same skin."""
    new = presses(20, seed=2)
    np.savez(folder / "new.npz", **new)
    tactomo(
        *("reconstruct", folder / "new.npz", folder / "maps.npz", "--force"),
        *("-d", folder / "skin.toml", *options),
        status=0,
    )
    maps = read_arrays(folder / "maps.npz")
    places = np.stack([maps["contact_x_mm"], maps["contact_y_mm"]], axis=1)
    return np.linalg.norm(places - new["xy_mm"][maps["contact_frame"]], axis=1), maps


@pytest.mark.slow
def test_a_taught_skin_is_located_better(tactomo: Run, tmp_path: Path) -> None:
    made = teach(tactomo, tmp_path, presses(30, seed=1))
    assert "palm: 30 presses of" in made.stdout
    assert f"kept in {TAUGHT.path('palm')}" in made.stdout
    shown = tactomo("teach", "show", "--sensor", "palm")
    assert shown.stdout.splitlines()[:2] == made.stdout.splitlines()[:2]
    kept = TAUGHT.read(TAUGHT.path("palm"))
    assert kept.with_mm < kept.without_mm
    untaught, maps = errors_mm(tactomo, tmp_path)
    assert not maps["contact_taught"].any()
    taught, maps = errors_mm(tactomo, tmp_path, "--taught", TAUGHT.path("palm"))
    assert maps["contact_taught"].mean() > 0.9
    assert np.median(taught) < 0.75 * np.median(untaught)
    sigma = maps["contact_x_sigma_mm"][maps["contact_taught"]]
    assert 0.3 < np.median(taught) / np.median(sigma) < 3


@pytest.mark.slow
def test_forces_are_taught_where_they_are_known(tactomo: Run, tmp_path: Path, good: Arrays) -> None:
    """Of each second press; a cover makes the physics' a quarter too small."""
    force_n = np.where(np.arange(60) % 2, np.nan, good["force_n"])
    made = teach(tactomo, tmp_path, changed(good, force_n=force_n))
    assert re.search(r"; forces to \d\.\d%$", made.stdout.splitlines()[0])
    true_n = presses(20, seed=2)["force_n"]

    def off(*options: Any) -> tuple[np.ndarray, np.ndarray]:
        _, maps = errors_mm(tactomo, tmp_path, *options)
        error_n = maps["contact_force_n"] - true_n[maps["contact_frame"]]
        return error_n / true_n[maps["contact_frame"]], error_n / maps["contact_force_sigma_n"]

    untaught, _ = off()
    assert np.nanmedian(untaught) < -0.15
    taught, in_sigmas = off("--taught", TAUGHT.path("palm"))
    assert np.median(np.abs(taught)) < 0.04
    assert 0.4 < (np.abs(in_sigmas) < 1).mean() < 0.95


@pytest.mark.slow
def test_forces_that_say_nothing_are_not_learnt(tactomo: Run, tmp_path: Path, good: Arrays) -> None:
    """Places are, all the same; it says why forces are not."""
    shuffled = np.random.default_rng(0).permutation(good["force_n"])
    few = np.where(np.arange(60) < 5, good["force_n"], np.nan)
    for force_n, why in (
        (shuffled, r"held-out ones are \d+% off"),
        (few, "5 are known .* 20 are needed"),
        (np.full(60, 9.81), "held-out .* 0% if all were alike"),
        (good["force_n"] * 1000 / 9.81, "they are 1.*; give newtons"),
    ):
        made = teach(tactomo, tmp_path, changed(good, force_n=force_n))
        assert re.search(f"forces are not learnt: {why}", made.stderr)
        assert "forces to" not in made.stdout
        assert TAUGHT.read(TAUGHT.path("palm")).forces is None


@pytest.mark.slow
def test_where_nothing_was_taught_the_frame_says_so(
    tactomo: Run, tmp_path: Path, good: Arrays
) -> None:
    """Taught on the left half alone."""
    left = good["xy_mm"][:, 0] < 0
    some = {k: v[left] if len(v) == len(left) else v for k, v in good.items()}
    teach(tactomo, tmp_path, some)
    _, before = errors_mm(tactomo, tmp_path)
    _, maps = errors_mm(tactomo, tmp_path, "--taught", TAUGHT.path("palm"))
    far = presses(20, seed=2)["xy_mm"][maps["contact_frame"], 0] > 40
    assert far.any()
    assert not maps["contact_taught"][far].any()
    assert ((maps["flags"][maps["contact_frame"]] & 32768) > 0)[far].all()
    np.testing.assert_allclose(maps["contact_x_mm"][far], before["contact_x_mm"][far])


def changed(arrays: Arrays, **changes: Any) -> Arrays:
    return {**arrays, **changes}


def swapped_rows(arrays: Arrays) -> Arrays:
    xy_mm = arrays["xy_mm"].copy()
    far = np.argsort(-np.abs(xy_mm[:, 0] - xy_mm[:, 1]))[:2]
    xy_mm[far] = xy_mm[far][:, ::-1]
    return changed(arrays, xy_mm=xy_mm)


def stored_twice(arrays: Arrays) -> Arrays:
    again = {name: arrays[name].copy() for name in ("magnitude", "structure")}
    for scans in again.values():
        scans[8] = scans[7]
    return changed(arrays, **again)


def unpressed(arrays: Arrays) -> Arrays:
    rest = {name: arrays[f"{name}_reference"] for name in ("magnitude", "structure")}
    noise = 1 + 1e-6 * np.random.default_rng(0).standard_normal((60, 208))
    return changed(arrays, **{name: noise * volts for name, volts in rest.items()})


def first(arrays: Arrays, count: int) -> Arrays:
    return {k: v[:count] if len(v) == len(arrays["xy_mm"]) else v for k, v in arrays.items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda a: changed(a, xy_mm=1e-3 * a["xy_mm"]), "seem to be metres; give millimetres"),
        (lambda a: changed(a, xy_mm=a["xy_mm"][:, ::-1]), "multiplied by 1, y by -1, both"),
        (lambda a: changed(a, xy_mm=2 * a["xy_mm"]), "x is multiplied by 0.5, y by 0.5, both"),
        (lambda a: changed(a, xy_mm=-a["xy_mm"]), "180 degrees"),
        (lambda a: changed(a, xy_mm=np.insert(a["xy_mm"], 8, a["xy_mm"][8], 0)[:-1]), "from press"),
        (lambda a: changed(a, xy_mm=np.roll(a["xy_mm"], 1, 0)), "60 places fit the contacts of"),
        (lambda a: changed(a, xy_mm=a["xy_mm"] + 75), "and moved by (-7"),
        (lambda a: changed(a, xy_mm=a["xy_mm"][:-1]), "xy_mm is float64 of shape (59, 2)"),
        (lambda a: changed(a, force_n=-a["force_n"]), "N presses nothing: give newtons, above 0"),
        (swapped_rows, "nothing is kept, as all others contradict press "),
        (stored_twice, "presses 7 and 8 hold the very same voltages"),
        (lambda a: first(a, 19), "19 presses are too few; give 20 or more"),
        (unpressed, "0 of 60 presses show one contact"),
    ],
)
def test_bad_presses_are_named_and_not_kept(
    tactomo: Run, tmp_path: Path, good: Arrays, spoil: Callable[[Arrays], Arrays], told: str
) -> None:
    result = teach(tactomo, tmp_path, spoil(good), status=1)
    assert told in result.stderr
    assert not TAUGHT.path("palm").exists()


@pytest.mark.slow
def test_presses_that_teach_nothing_are_not_kept(
    tactomo: Run, tmp_path: Path, good: Arrays
) -> None:
    """A template that is worse than the physics: places good to 5 mm."""
    off = np.random.default_rng(0).normal(0, 5, good["xy_mm"].shape)
    spoilt = changed(good, xy_mm=good["xy_mm"] + off)
    result = teach(tactomo, tmp_path, spoilt, "--keep-odd", status=1)
    assert "nothing is kept: of 60 presses" in result.stderr
    assert not TAUGHT.path("palm").exists()


@pytest.mark.slow
def test_another_skin_is_refused(tactomo: Run, tmp_path: Path, good: Arrays) -> None:
    teach(tactomo, tmp_path, good)
    np.savez(tmp_path / "other.npz", **presses(3, seed=3, skin=5))
    result = tactomo(
        *("reconstruct", tmp_path / "other.npz", tmp_path / "maps.npz"),
        *("-d", tmp_path / "skin.toml", "--taught", TAUGHT.path("palm")),
        status=1,
    )
    assert "does not fit this skin" in result.stderr
    assert "voltages at rest" in result.stderr


def test_a_damaged_file_is_told(tactomo: Run, tmp_path: Path) -> None:
    result = tactomo("teach", "show", "--sensor", "palm")
    assert (result.returncode, "tactomo teach live --sensor palm" in result.stderr) == (1, True)
    path = TAUGHT.path("palm")
    path.parent.mkdir(parents=True)
    path.write_bytes(b"PK")
    result = tactomo("teach", "show", "--sensor", "palm", status=1)
    assert "is damaged" in result.stderr
