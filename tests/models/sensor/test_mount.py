"""Where a sheet lies on a robot: places become points and normals, and bad mounts are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_sensor import SMALL
from tactomo_models import DescriptionError, load_description
from tactomo_models.sensor.description_file import carried_text, parse_description
from tactomo_models.sensor.mount import Mount, SurfaceMount


def bent_obj(
    width_m: float,
    height_m: float,
    radius_m: float,
    cells: int = 12,
    *,
    stretch: float = 1.0,
    unit: float = 1.0,  # of the vertices, in metres
    texture: str = "vt {x:.6f} {y:.6f}",
) -> str:
    """A sheet that is bent around the link's z axis, its middle at x = radius."""
    lines = []
    for y in np.linspace(-height_m / 2, height_m / 2, cells + 1):
        for x in np.linspace(-width_m / 2, width_m / 2, cells + 1):
            angle = stretch * x / radius_m
            point = np.array([radius_m * np.cos(angle), radius_m * np.sin(angle), y]) / unit
            lines.append(f"v {point[0]:.6f} {point[1]:.6f} {point[2]:.6f}")
            lines.append(texture.format(x=x, y=y, u=x / width_m + 0.5, v=y / height_m + 0.5))
    for row in range(cells):
        for column in range(cells):
            number = row * (cells + 1) + column + 1
            corners = (number, number + 1, number + cells + 2, number + cells + 1)
            lines.append("f " + " ".join(f"{n}/{n}" if texture else f"{n}" for n in corners))
    return "\n".join(lines) + "\n"


RADIUS_M = 0.02
MOUNTS = {
    "plane": "position_m = [0.1, 0.2, 0.3]\nquaternion = [0.5, 0.5, 0.5, 0.5]",
    "cylinder": f"radius_m = {RADIUS_M}",
    "surface": 'file = "bent.obj"',
}


def mounted(folder: Path, kind: str, keys: str = "", obj: str = "") -> Mount:
    """The mount of the small sensor, read from a file."""
    (folder / "bent.obj").write_text(obj or bent_obj(0.06, 0.05, RADIUS_M, 24))
    file = folder / "small.toml"
    section = f'[mount]\nframe = "arm"\n[mount.{kind}]\n{keys or MOUNTS[kind]}\n'
    file.write_text(SMALL + section)
    mount = load_description(file).mount
    assert mount is not None
    return mount


def places(count: int = 50) -> np.ndarray:
    return np.random.default_rng(1).uniform((-0.03, -0.025), (0.03, 0.025), (count, 2))


@pytest.mark.parametrize("kind", MOUNTS)
def test_a_place_and_what_is_above_it_are_found_again(tmp_path: Path, kind: str) -> None:
    mount, xy_m = mounted(tmp_path, kind), places()
    points, normals = mount.place(xy_m)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)
    found, height = mount.unplace(points + 0.003 * normals)
    assert np.abs(found - xy_m).max() < 2e-4  # triangles stand for a round surface
    assert height == pytest.approx(0.003, abs=5e-5)


@pytest.mark.parametrize("kind", MOUNTS)
def test_the_normal_is_x_times_y(tmp_path: Path, kind: str) -> None:
    mount, xy_m = mounted(tmp_path, kind), places()
    step = 1e-4
    points, normals = mount.place(xy_m)
    along_x, along_y = (
        (mount.place(xy_m + np.eye(2)[axis] * step)[0] - points) / step for axis in (0, 1)
    )
    assert (np.cross(along_x, along_y) * normals).sum(axis=1) == pytest.approx(1, abs=0.02)


def test_a_plane_is_turned_by_its_quaternion(tmp_path: Path) -> None:
    points, normals = mounted(tmp_path, "plane").place(np.array([[0.01, 0.02]]))
    assert points[0] == pytest.approx([0.1 + 0.0, 0.2 + 0.01, 0.3 + 0.02])  # x -> y -> z -> x
    assert normals[0] == pytest.approx([1, 0, 0])


@pytest.mark.parametrize(
    ("along", "quarter", "point"),
    [
        ("y", (np.pi / 2 * RADIUS_M, 0.01), (0, RADIUS_M, 0.01)),
        ("x", (0.01, np.pi / 4 * RADIUS_M), (RADIUS_M * 0.5**0.5, -RADIUS_M * 0.5**0.5, 0.01)),
    ],
)
def test_a_cylinder_goes_round_its_axis(
    tmp_path: Path, along: str, quarter: tuple[float, float], point: tuple[float, ...]
) -> None:
    mount = mounted(tmp_path, "cylinder", f'radius_m = {RADIUS_M}\nalong = "{along}"')
    points, normals = mount.place(np.array([quarter]))
    assert points[0] == pytest.approx(point)
    assert normals[0] == pytest.approx(np.array(point) * (1, 1, 0) / RADIUS_M)


def test_a_surface_of_triangles_is_the_cylinder_that_it_stands_for(tmp_path: Path) -> None:
    of_triangles, exact = mounted(tmp_path, "surface"), mounted(tmp_path, "cylinder")
    (points, normals), (true_points, true_normals) = (
        mount.place(places()) for mount in (of_triangles, exact)
    )
    assert np.abs(points - true_points).max() < 1e-4
    assert np.abs(normals - true_normals).max() < 0.02


def test_the_faces_of_a_fold_stay_flat(tmp_path: Path) -> None:
    """Two plates that meet at 35 degrees along the sheet's y, each of one rectangle."""
    out, up = np.cos(np.radians(35)), np.sin(np.radians(35))
    rows = [(x, y) for y in (-0.03, 0.03) for x in (-0.04, 0.0, 0.04)]
    corners = "".join(
        f"v {x if x < 0 else out * x} {y} {max(0.0, up * x)}\nvt {x} {y}\n" for x, y in rows
    )
    mount = mounted(tmp_path, "surface", obj=corners + "f 1/1 2/2 5/5 4/4\nf 2/2 3/3 6/6 5/5\n")
    _, normals = mount.place(np.array([[-0.02, 0.01], [-0.001, 0.0], [0.001, 0.0]]))
    assert normals == pytest.approx(np.array([[0, 0, 1], [0, 0, 1], [-up, 0, out]]))


def test_a_recording_carries_the_surface(tmp_path: Path) -> None:
    mounted(tmp_path, "surface")
    description = load_description(tmp_path / "small.toml")
    text = carried_text(description, str(tmp_path / "small.toml"))
    (tmp_path / "bent.obj").unlink()
    assert parse_description(text, "recording") == description


def test_models_are_those_of_the_flat_sheet(tmp_path: Path) -> None:
    mounted(tmp_path, "cylinder")
    (tmp_path / "flat.toml").write_text(SMALL)
    bent, flat = (load_description(tmp_path / f"{name}.toml") for name in ("small", "flat"))
    assert bent.sha256 == flat.sha256


@pytest.mark.parametrize(("stretch", "is_own"), [(1.005, False), (1.1, True), (0.9, True)])
def test_a_surface_that_stretches_the_sheet_has_models_of_its_own(
    tmp_path: Path, stretch: float, is_own: bool
) -> None:
    mounted(tmp_path, "surface", obj=bent_obj(0.06, 0.05, RADIUS_M, 24, stretch=stretch))
    (tmp_path / "flat.toml").write_text(SMALL)
    other, flat = (load_description(tmp_path / f"{name}.toml") for name in ("small", "flat"))
    assert (other.sha256 != flat.sha256) == is_own
    assert other.area_factor(np.zeros(1), np.zeros(1)) == pytest.approx(
        stretch if is_own else 1, rel=0.01
    )


FACES = "f 1/1 2/2 3/3"


@pytest.mark.parametrize(
    ("kind", "keys", "said"),
    [
        ("plane", "quaternion = [0, 0, 0, 2]", ["quaternion", "length is 2", "[0.0000, 0.0000, 0"]),
        ("plane", "quaternion = [0, 0, 0, 0]", ["quaternion", "no direction"]),
        ("plane", "position_m = [0, nan, 0]", ["mount.plane.position_m.1", "finite number"]),
        ("cylinder", "radius_m = 0.009", ["goes round", "1.06 times", "0.009549 m", 'along = "x"']),
        ("cylinder", "radius_m = 0.02\naxis = [0, 0, 2]", ["axis", "length is 2"]),
        ("cylinder", "radius_m = 0.02\nseam = [-0.8, 0, 0.6]", ["right angle", "[-1.0000, 0"]),
        ("cylinder", "radius_m = 40", ["in millimetres? 40 mm are 0.04 m"]),
        ("surface", 'file = "none.obj"', ["none.obj", "No such file", "OBJ file"]),
        ("surface", "", ["mount.surface.file is missing"]),
        ("sphere", "radius_m = 1", ["unknown key mount.sphere"]),
    ],
)
def test_a_mount_that_cannot_be_is_named(
    tmp_path: Path, kind: str, keys: str, said: list[str]
) -> None:
    with pytest.raises(DescriptionError) as caught:
        mounted(tmp_path, kind, keys or "# nothing")
    for part in ["small.toml", *said]:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("obj", "said"),
    [
        (bent_obj(0.06, 0.05, 0.02, texture=""), ["line", "texture coordinates", "UVs"]),
        (bent_obj(60, 50, 20), ["span 60 x 50", "in millimetres? divide them (vt) by 1000"]),
        (
            bent_obj(0.06, 0.05, 0.02, unit=1e-3),
            ["times as long as its texture", "divide them (v) by 1000"],
        ),
        (bent_obj(0.06, 0.05, 0.02, texture="vt {u:.4f} {v:.4f}"), ["0 to 1", "(u - 0.5) * 0.06"]),
        (bent_obj(0.04, 0.05, 0.02), ["no triangle covers the sheet", "must cover"]),
        (bent_obj(0.06, 0.05, 0.02, stretch=2.2), ["2.17", "times as long", "0.5 to 2 can"]),
        (bent_obj(0.06, 0.05, 0.02) * 2, ["same texture coordinates", "without overlap"]),
        ("v 0 0 0\nv 1 0 0\nv nan 1 0\n", ["line 3", "finite numbers"]),
        ("v 0 0 0\nvt 0 0\nf 1/1 2/2 3/3\n", ["line 3", "vertices that come before"]),
        ("v 0 0 0\n", ["no faces"]),
        ("\n", ["it is empty"]),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nvt 0 0\nvt 1 0\nvt 2 0\n" + FACES, ["no area", "unwrap"]),
    ],
)
def test_a_surface_that_carries_no_sheet_is_named(
    tmp_path: Path, obj: str, said: list[str]
) -> None:
    with pytest.raises(DescriptionError) as caught:
        mounted(tmp_path, "surface", obj=obj)
    for part in ["small.toml", "bent.obj", *said]:
        assert part in str(caught.value)


WORDS = ["v", "vt", "f", "1", "0.02", "-1", "1/1", "2/2", "3/3", "9/9", "1e308", "nan", "/", "#"]


@given(st.lists(st.lists(st.sampled_from(WORDS), max_size=5).map(" ".join), max_size=20))
def test_whatever_an_obj_file_says_is_read_or_named(lines: list[str]) -> None:
    text = bent_obj(0.06, 0.05, 0.02, 2) + "\n".join(lines)
    said = ""
    try:
        SurfaceMount(file="any.obj", obj=text).check((0.06, 0.05), places(5))
    except ValueError as error:
        said = str(error)
    assert not said or "any.obj" in said


def test_one_mount_is_given(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match=r"give one of \[mount.plane\]"):
        mounted(tmp_path, "plane", "[mount.cylinder]\nradius_m = 0.02")
