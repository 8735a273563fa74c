"""Models of EIDORS and pyEIT become descriptions that give those programs' voltages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyeit import mesh  # type: ignore[import-untyped]
from pyeit.eit import fem, protocol  # type: ignore[import-untyped]
from scipy.io import savemat
from scipy.sparse import csc_array
from tactomo_models import DataError, DescriptionError, SensorDescription
from tactomo_models.imported.mesh import read_model
from tactomo_models.imported.model import describe
from tactomo_models.physics.bare_sheet import solve_bare_sheet
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import mesh_sheet
from tactomo_models.sensor.outline import Pad

RADIUS_MM = 140


@pytest.fixture(scope="module")
def disc() -> Any:
    return mesh.create(16, h0=0.07)


def saved(path: Path, disc: Any, made: Any) -> Path:
    arrays = {"node": disc.node, "element": disc.element, "el_pos": disc.el_pos}
    np.savez(path, **arrays, ex_mat=made.ex_mat, meas_mat=made.meas_mat)
    return path


def described(path: Path, electrode_mm: float | None = None) -> SensorDescription:
    return describe(read_model(path, RADIUS_MM), path, "tank", electrode_mm)[1]


@pytest.mark.slow
@pytest.mark.parametrize("apart", [1, 8])
def test_a_pyeit_model_gives_pyeits_voltages_and_is_not_mirrored(
    tmp_path: Path, disc: Any, apart: int
) -> None:
    """Of a thing off the axes, which a mirrored or turned sheet would have elsewhere."""
    made = protocol.create(16, apart, 1, "std")
    sensor = described(saved(tmp_path / "tank.npz", disc, made), 2.0)
    assert sensor.electrode_centres_m[0] == pytest.approx((-0.14, 0), abs=1e-3)
    assert sensor.electrode_centres_m[1][1] > 0  # clockwise from 180 degrees
    theirs = fem.EITForward(disc, made)
    middles = disc.node[disc.element, :2].mean(axis=1)
    inside = np.hypot(*(middles - [0.5, 0.2]).T) < 0.25
    before, after = theirs.solve_eit(np.ones(len(middles))), theirs.solve_eit(1 + inside)
    ours = ForwardModel(sensor, solve_bare_sheet(sensor, mesh_sheet(sensor)))
    place = 1e3 * ours.bare.points[:, ours.bare.pressable] / RADIUS_MM
    change = (np.hypot(*(place - [[0.5], [0.2]])) < 0.25).astype(float)
    differences = after - before, ours.solve(change).voltages - ours.bare_voltages
    assert np.corrcoef(before, ours.bare_voltages)[0, 1] > 0.99
    assert np.corrcoef(*differences)[0, 1] > 0.98


def eidors(path: Path, disc: Any, rotated: bool = False, hole: Any = None) -> Path:
    """Save as EIDORS has it: electrodes clockwise from the top, of several nodes, sparse rows.

    Another one is round a hole, where one is given: the elements (n,) that are cut out.
    """
    count, elements = 16, disc.element
    if hole is not None:
        count, elements = 17, disc.element[~hole]
    ring = np.arange(count)
    electrode = np.zeros((1, count), [("nodes", object), ("z_contact", object)])
    stimulation = np.zeros((1, count), [("stim_pattern", object), ("meas_pattern", object)])
    angle = np.arctan2(disc.node[:, 1], disc.node[:, 0])
    on_rim = np.abs(np.hypot(*disc.node[:, :2].T) - 1) < 1e-6
    for k in range(16):
        off = np.angle(np.exp(1j * (angle - np.pi / 2 + 2 * np.pi * k / 16)))
        electrode[0, k] = np.flatnonzero(on_rim & (np.abs(off) < 0.11))[None] + 1.0, 0.01
    if hole is not None:
        round_it = np.intersect1d(disc.element[hole], elements)
        electrode[0, 16] = round_it[None] + 1.0, 0.01
    for k in range(count):
        pairs = np.eye(count)[(ring + 1) % count] - np.eye(count)  # plus k + 1, minus k
        rows = pairs[(np.abs(pairs) * np.abs(pairs[k])).sum(axis=1) == 0]
        current = csc_array(0.01 * pairs[k][:, None])
        stimulation[0, k] = current, csc_array(np.roll(rows, -k if rotated else 0, axis=0))
    model = {"nodes": disc.node[:, :2], "elems": elements + 1.0, "type": "fwd_model"}
    savemat(path, {"fmdl": model | {"electrode": electrode, "stimulation": stimulation}})
    return path


@pytest.mark.slow
def test_an_eidors_model_has_its_electrodes_and_its_pattern(tmp_path: Path, disc: Any) -> None:
    sensor = described(eidors(tmp_path / "fmdl.mat", disc))
    assert sensor.sheet.shape == "disc"
    assert 2 * sensor.width_m == pytest.approx(0.56, rel=1e-3)
    places = sensor.electrode_centres_m
    assert places[0] == pytest.approx((0, 0.14), abs=2e-3)
    assert places[4] == pytest.approx((0.14, 0), abs=2e-3)  # clockwise
    assert 0.015 < sensor.electrodes.length_m < 0.03
    assert sensor.measurements == 208
    assert sensor.offsets == (1, 1)
    assert sensor.pattern.current_a == 0.01


def test_an_electrode_round_a_hole_becomes_a_pad(tmp_path: Path, disc: Any) -> None:
    middles = disc.node[disc.element, :2].mean(axis=1)
    hole = np.hypot(*(middles - [0.3, 0.2]).T) < 0.15
    sensor = described(eidors(tmp_path / "fmdl.mat", disc, hole=hole))
    assert (sensor.sheet.shape, sensor.sheet.holes_m) == ("disc", ())
    assert sensor.electrode_count == 17
    pad = sensor.placed_electrodes[16]
    assert isinstance(pad, Pad)
    assert pad.centre_m == pytest.approx((0.3 * 0.14, 0.2 * 0.14), abs=0.006)
    assert pad.radius_m == pytest.approx(0.15 * 0.14, rel=0.2)


def test_voltages_in_another_order_are_told(tmp_path: Path, disc: Any) -> None:
    made = protocol.create(16, 8, 1, "rotate_meas")
    model = read_model(saved(tmp_path / "tank.npz", disc, made), RADIUS_MM)
    assert model.pattern is not None
    assert "--pattern 16:opposite:adjacent:rotated" in model.pattern.note


@pytest.mark.parametrize(
    ("array", "value"),
    [
        ("node", np.nan),
        ("node", 1e308),
        ("node", 0),
        ("element", 0),
        ("ex_mat", np.inf),
        ("ex_mat", 1e308),
    ],
)
def test_a_damaged_model_is_told(tmp_path: Path, disc: Any, array: str, value: float) -> None:
    with np.load(saved(tmp_path / "tank.npz", disc, protocol.create(16, 1, 1, "std"))) as held:
        arrays = {**held, array: np.full(held[array].shape, value)}
    np.savez(tmp_path / "tank.npz", **arrays)
    with pytest.raises(DataError):
        read_model(tmp_path / "tank.npz", RADIUS_MM)


def test_what_no_description_can_have_is_refused_by_name(tmp_path: Path, disc: Any) -> None:
    made = protocol.create(16, 1, 1, "std")
    path = saved(tmp_path / "tank.npz", disc, made)
    with pytest.raises(DataError, match="--unit-mm"):
        read_model(path)
    with pytest.raises(DataError, match="--electrode-mm"):
        described(path)
    with pytest.raises(DescriptionError, match="--unit-mm"):
        describe(read_model(path, 1e-3), path, "tank", 2.0)
    made.meas_mat = made.meas_mat[:, :5]
    with pytest.raises(DataError, match="shares no electrode"):
        described(saved(path, disc, made), 2.0)
    disc.node[0, 2] = 1.0
    try:
        with pytest.raises(DataError, match="three dimensions"):
            described(saved(path, disc, made), 2.0)
    finally:
        disc.node[0, 2] = 0.0
    np.savez(path, anything=np.ones(3))
    with pytest.raises(DataError, match=r"save\('model.mat'"):
        described(path, 2.0)
