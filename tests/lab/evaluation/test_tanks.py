"""Tanks that hold what conducts better and what conducts worse, simulated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import spearmanr
from simulated_tanks import simulated_tanks
from tactomo_lab.evaluation.tanks import (
    TankImager,
    Tanks,
    evaluate_tanks,
    expected_correlation,
    on_pixels,
    read_tanks,
)
from tactomo_lab.scenes.measures import correlation
from tactomo_models import (
    Artifact,
    DataError,
    MethodError,
    Reconstructor,
    SensorDescription,
    build_artifact,
    load_description,
)
from tactomo_models.batch import reconstruct_file
from tactomo_models.physics.bare_sheet import volts_per_unit
from tactomo_models.physics.forward import ForwardModel


@pytest.fixture(scope="module")
def tank() -> SensorDescription:
    return load_description("tank_uef2017")


@pytest.fixture(scope="module")
def tank_artifact(tank: SensorDescription) -> Artifact:
    return build_artifact(tank)


@pytest.fixture(scope="module")
def imager(tank: SensorDescription, tank_artifact: Artifact) -> TankImager:
    return TankImager(tank, tank_artifact)


@pytest.fixture(scope="module")
def drawn(tank: SensorDescription) -> Tanks:
    """The first simulated tank with objects of both kinds, in the model's units."""
    some = simulated_tanks(tank, "tuning", 3)
    both = [i for i, truth in enumerate(some.truth) if truth.min() < 0 < truth.max()][:1]
    assert both
    changes = some.changes[both] / volts_per_unit(tank)
    return Tanks(tuple(some.names[i] for i in both), changes, some.truth[both])


def test_both_kinds_are_found_with_the_right_sign(imager: TankImager, drawn: Tanks) -> None:
    methods = ("tikhonov", "noser", "network")
    outcomes = {o.method: o for o in evaluate_tanks(imager, drawn, methods, 1.0)}
    truth = drawn.truth[0]
    for outcome in outcomes.values():
        assert outcome.correlation > 0.4
        assert outcome.image[truth > 0].mean() > 0.2
        assert outcome.image[truth < 0].mean() < -0.2
    for linear in ("tikhonov", "noser"):
        assert outcomes[linear].correlation < outcomes["network"].correlation - 0.05


@pytest.mark.parametrize("method", ["auto", "fit"])
def test_live_there_is_a_linear_image_and_the_frame_says_so(
    imager: TankImager, drawn: Tanks, method: str
) -> None:
    frame, noser = (imager.reconstruct(drawn.changes[0], name) for name in (method, "noser"))
    assert frame.tier == "noser"
    assert "better or worse" in frame.reason
    np.testing.assert_array_equal(frame.structure, noser.structure)
    assert len(frame.contacts) >= 2


def test_objects_of_two_kinds_that_touch_are_two_contacts(
    tank: SensorDescription, tank_artifact: Artifact, imager: TankImager
) -> None:
    """Two discs side by side, of voltages that are linear in the conductivity."""
    forward = ForwardModel(tank, tank_artifact.bare)
    x, y = forward.bare.points[:, forward.bare.pressable]
    better, worse = (np.hypot(x - side * 0.04, y) < 0.04 for side in (1, -1))
    relative = tank_artifact.jacobian @ (0.1 * better - 0.1 * worse)
    frame = imager.reconstruct(relative * np.abs(forward.bare_voltages), "auto")
    left, right = sorted(frame.contacts, key=lambda contact: contact.x_m)
    assert (left.x_m, left.y_m) == pytest.approx((-0.04, 0), abs=0.015)
    assert (right.x_m, right.y_m) == pytest.approx((0.04, 0), abs=0.015)


def test_a_level_set_knows_one_kind_and_is_refused(tank: SensorDescription) -> None:
    with pytest.raises(MethodError, match=r"levelset.*tank_uef2017.*better or worse; use auto"):
        Reconstructor(tank, method="levelset")


def test_a_file_of_scans_of_such_a_tank(
    tank: SensorDescription, tank_artifact: Artifact, drawn: Tanks, tmp_path: Path
) -> None:
    """What a user has: volts with objects and without; contacts are of both kinds."""
    empty = ForwardModel(tank, tank_artifact.bare).bare_voltages
    scan = empty + np.sign(empty) * drawn.changes[0]
    np.savez(
        tmp_path / "in.npz",
        structure=np.array([scan, scan, empty]) * 3.0,
        structure_reference=empty * 3.0,
    )
    made = reconstruct_file(tmp_path / "in.npz", tmp_path / "out.npz", description=tank)
    assert made.frames == 3
    with np.load(tmp_path / "out.npz") as out:
        maps = out["structure"]
        assert -1 <= maps.min() < -0.5
        assert 0.3 < maps.max() <= 1
        assert correlation(on_pixels(tank, maps[0], (128, 128)), drawn.truth[0]) > 0.6
        np.testing.assert_array_equal(maps[1], maps[0])  # a still scene stays as it is
        assert not maps[2].any()
        at = out["contact_frame"] == 0
        where = np.stack([out["contact_y_mm"][at], out["contact_x_mm"][at]], axis=1) * 1e-3
    rows = np.round((1 - where[:, 0] / 0.14) * 64 - 0.5).astype(int)
    columns = np.round((1 + where[:, 1] / 0.14) * 64 - 0.5).astype(int)
    assert set(drawn.truth[0][rows, columns]) == {-1.0, 1.0}


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("thin", [False, True])
def test_simulated_tanks_whatever_their_scale(
    tank: SensorDescription, imager: TankImager, thin: bool
) -> None:
    """Seeds that nothing was chosen by; the confidence tells the bad ones."""
    some = simulated_tanks(tank, "reporting", 60, thin)
    methods = ("noser", "network")
    outcomes = list(evaluate_tanks(imager, some, methods))
    mean = {
        method: np.mean([o.correlation for o in outcomes if o.method == method])
        for method in methods
    }
    found = [o for o in outcomes if o.method == "network"]
    ranks = spearmanr([o.confidence for o in found], [o.correlation for o in found])[0]
    print(f"thin={thin}: correlation {mean['network']:.3f}, ranked by {ranks:.2f}")
    assert mean["network"] > (0.82 if thin else 0.905)  # the network alone: 0.78 and 0.901
    assert mean["network"] > mean["noser"] + 0.1
    assert ranks > 0.4
    first, other_unit = (
        Tanks(some.names[:1], factor * some.changes[:1], some.truth[:1]) for factor in (1, 1e4)
    )
    images = [next(evaluate_tanks(imager, t, ["network"])).image for t in (first, other_unit)]
    np.testing.assert_allclose(images[0], images[1], atol=1e-4)


def test_what_is_expected_of_a_certain_image() -> None:
    certain = np.zeros((3, 64, 64))
    certain[1, 20:30, 20:30] = certain[2, 40:50, 20:30] = 1
    certain[0] = 1 - certain[1] - certain[2]
    assert expected_correlation(certain) == pytest.approx(1)
    assert expected_correlation(0.5 * certain + 0.5 * certain[[1, 0, 2]]) < 0.75


def test_what_is_no_set_of_tanks(tank: SensorDescription, tmp_path: Path) -> None:
    good: dict[str, Any] = {
        "dv": np.full((2, 208), -1e-3),
        "truth": np.zeros((2, 16, 16), np.int8),
        "name": np.array(["a", "b"]),
    }
    path = tmp_path / "tanks.npz"
    np.savez(path, **good)
    assert read_tanks(path, tank).names == ("a", "b")
    for change, told in (
        ({"dv": np.zeros((2, 200))}, "200"),
        ({"dv": np.full((2, 208), np.nan)}, "not numbers"),
        ({"truth": np.zeros((2, 16))}, "truth"),
        ({"truth": np.zeros((3, 16, 16))}, "truth"),
        ({"name": np.array(["a"])}, "dv is"),
        ({"dv": np.array([["a"]])}, "none that is real"),
    ):
        np.savez(path, **{**good, **change})
        with pytest.raises(DataError, match=told):
            read_tanks(path, tank)
    np.savez(path, dv=good["dv"])
    with pytest.raises(DataError, match="truth"):
        read_tanks(path, tank)
    with pytest.raises(DataError, match="cannot read"):
        read_tanks(tmp_path / "absent.npz", tank)


def test_pixels_and_correlation(tank: SensorDescription) -> None:
    x, y = np.meshgrid(tank.map_x_m, tank.map_y_m)
    image = on_pixels(tank, (3 * x + 5 * y).astype(np.float32), (32, 32))
    assert image[2, 16] > image[29, 16]  # row 0 is the top
    assert image[16, 29] > image[16, 2]
    assert np.isnan(image[0, 0])
    on = np.isfinite(image)
    assert on.mean() == pytest.approx(np.pi / 4, abs=0.02)
    assert correlation(image, np.where(on, image, 7.0)) == pytest.approx(1)
    assert correlation(image, -2 * image + 1) == pytest.approx(-1)
    assert correlation(np.where(on, 0.5, np.nan), image) == 0
