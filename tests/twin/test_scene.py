"""Scripted scenes: the time line, and what a wrong file is told."""

from __future__ import annotations

from pathlib import Path

import pytest
from tactomo.errors import ConfigError
from tactomo.twin import Scene, load_scene
from tactomo.twin.scene import SHIPPED


def scene(**press: object) -> Scene:
    base = {"at_s": 1.0, "duration_s": 4.0, "x_mm": 0.0, "y_mm": 10.0}
    return Scene.model_validate({"press": [{**base, **press}]})


def test_a_press_is_there_from_its_start_to_its_end() -> None:
    still = scene()
    assert still.presses_at(0.99) == {}
    assert still.presses_at(1.0)["scene-0"].press().y_m == pytest.approx(0.010)
    assert still.presses_at(4.99).keys() == {"scene-0"}
    assert still.presses_at(5.0) == {}


def test_a_path_is_followed_in_straight_lines_and_ends_at_its_last_point() -> None:
    path = [
        {"after_s": 2.0, "x_mm": 20.0, "y_mm": 10.0},
        {"after_s": 3.0, "x_mm": 20.0, "y_mm": -10.0, "pressure_kpa": 200.0},
    ]
    moving = scene(path=path, pressure_kpa=100.0)
    places = [moving.presses_at(t)["scene-0"] for t in (1.0, 2.0, 3.5, 4.5)]
    assert [(p.x_mm, p.y_mm, p.pressure_kpa) for p in places] == [
        (0.0, 10.0, 100.0),
        (10.0, 10.0, 100.0),
        (20.0, 0.0, 150.0),
        (20.0, -10.0, 200.0),
    ]


def test_a_ramp_rises_from_zero_and_falls_to_zero() -> None:
    ramped = scene(ramp_s=1.0, pressure_kpa=100.0)
    assert ramped.presses_at(1.0) == {}
    assert ramped.presses_at(1.25)["scene-0"].pressure_kpa == pytest.approx(25.0)
    assert ramped.presses_at(3.0)["scene-0"].pressure_kpa == pytest.approx(100.0)
    assert ramped.presses_at(4.75)["scene-0"].pressure_kpa == pytest.approx(25.0)


def test_a_loop_starts_over_after_its_duration() -> None:
    once = scene()
    looped = once.model_copy(update={"loop": True, "duration_s": 10.0})
    assert once.presses_at(12.0) == {}
    assert looped.presses_at(12.0) == looped.presses_at(2.0) != {}


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_scenes_load_and_leave_time_to_take_a_reference(name: str) -> None:
    shipped = load_scene(name)
    assert all(shipped.presses_at(t / 10) == {} for t in range(29))
    assert any(shipped.presses_at(t / 10) for t in range(29, int(shipped.length_s * 10)))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("press = [", "not valid TOML"),
        ("colour = 1", "unknown key colour"),
        ("[[press]]\nat_s=0\nduration_s=1\nx_mm=0\ny_mm=0\nradius_mm=-3", "radius_mm = -3"),
        ("[[press]]\nat_s=0\nduration_s=1\nx_mm=0\ny_mm=0\nshape='star'", "'ellipse'"),
        ("[[press]]\nat_s=0\nduration_s=1\nx_mm=nan\ny_mm=0", "press.0.x_mm = nan"),
        ("[[press]]\nat_s=0\nduration_s=1\nx_mm=0\ny_mm=0\nramp_s=0.6", "at most half"),
        ("duration_s=0.5\n[[press]]\nat_s=0\nduration_s=1\nx_mm=0\ny_mm=0", "at least 1"),
        (
            "[[press]]\nat_s=0\nduration_s=1\nx_mm=0\ny_mm=0\n"
            "path=[{after_s=0.5,x_mm=0,y_mm=0},{after_s=0.5,x_mm=0,y_mm=0}]",
            "rise from waypoint to waypoint",
        ),
    ],
)
def test_a_wrong_scene_is_refused_with_what_is_wrong(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_scene(path)
    assert says in str(caught.value)
    assert str(path) in str(caught.value)
