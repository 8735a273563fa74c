"""A skin in MuJoCo: forces are kept, borders cut and told, nothing invented, presses found."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from page import Page
from stretched import along, on_surface
from tactomo_models import DataError, load_description
from tactomo_models.sensor.companion import Companion
from tactomo_models.simulators.mujoco_skin import MujocoSkin, Touch
from variants import variant

STEPS = 300
CELL_M2 = 0.003**2

PLATE = """
<mujoco>
  <option timestep="0.002"/>
  <default><geom solref=".004 1"/></default>
  <worldbody>
    <body name="arm" pos="0.3 -0.2 0.5" euler="0 {tilt} 0">
      <geom name="plate" type="box" size=".09 .09 .01" pos="0 0 -.01"/>
      <site name="skin"/>
      {bodies}
    </body>
  </worldbody>
</mujoco>
"""
"""Bodies are pressed on the plate by springs, so that it may be turned whichever way."""


def body(name: str, geom: str, x_mm: float, y_mm: float, force_n: float, z_mm: float = 0) -> str:
    """A body that slides along the plate's normal and is pressed on the plate, or from behind."""
    up = "-1" if z_mm < 0 else "1"
    return f"""
      <body name="{name}" pos="{x_mm / 1e3} {y_mm / 1e3} {z_mm / 1e3}">
        <joint type="slide" axis="0 0 {up}" damping="200" stiffness="1e-3"
               springref="{-force_n * 1e3}"/>
        <geom name="{name}" {geom} mass=".1"/>
      </body>"""


BALL = 'type="sphere" size=".04" pos="0 0 .04"'


def settled(*bodies: str, tilt: float = 0) -> tuple[Any, Any]:
    """A model and its data once nothing moves any more; without gravity."""
    xml = PLATE.format(bodies="".join(bodies), tilt=tilt)
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.gravity[:] = 0
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, STEPS)
    return model, data


def felt(*bodies: str, tilt: float = 0, **options: Any) -> Touch:
    """What the skin feels of bodies."""
    model, data = settled(*bodies, tilt=tilt)
    return MujocoSkin(model, "skin", **{"method": "network", **options}).feel(data)


def truth_n(touch: Touch) -> float:
    """Force of the true pressure on the map's nodes."""
    return float(touch.truth_kpa.sum()) * 1e3 * CELL_M2


@pytest.mark.slow
@pytest.mark.parametrize("tilt", [0, 180, 37])
def test_a_ball_is_found_where_it_presses_and_as_hard(tilt: float) -> None:
    touch = felt(body("ball", BALL, 20, -15, 90), tilt=tilt, method="auto")
    assert touch.force_n == pytest.approx(90, rel=0.01)
    assert touch.lost_n == 0
    assert touch.outside == ()
    assert truth_n(touch) == pytest.approx(touch.force_n, rel=0.02)
    # Hertz: a = (3 F R / 4 E*)^(1/3) = 13.9 mm, p0 = 3 F / 2 pi a^2 = 221 kPa
    assert touch.truth_kpa.max() == pytest.approx(221, rel=0.04)
    (contact,) = touch.frame.contacts
    assert (contact.x_m * 1e3, contact.y_m * 1e3) == pytest.approx((20, -15), abs=1)
    assert contact.force_n == pytest.approx(90, rel=0.15)
    assert contact.area_m2 == pytest.approx(np.pi * 0.0139**2, rel=0.15)


@pytest.mark.slow
def test_a_ball_is_as_large_on_a_sheet_that_is_stretched() -> None:
    """The plate is the sheet at 1.2 times its width."""
    stretched = on_surface(load_description("paper_square"), along(1.2, 1.0))
    touch = felt(body("ball", BALL, 24, -15, 90), description=stretched, method="fit")
    assert touch.force_n == pytest.approx(90, rel=0.01)
    assert 1.2 * truth_n(touch) == pytest.approx(touch.force_n, rel=0.02)
    assert touch.truth_kpa.max() == pytest.approx(221, rel=0.04)
    (contact,) = touch.frame.contacts
    assert contact.position_m == pytest.approx((0.024, -0.015, 0.0), abs=1e-3)
    assert contact.force_n == pytest.approx(90, rel=0.15)


def test_several_contacts_add_up() -> None:
    box = 'type="box" size=".02 .02 .01" pos="0 0 .01"'
    model, data = settled(body("ball", BALL, -30, 0, 80), body("box", box, 35, 10, 120))
    assert data.ncon == 5
    touch = MujocoSkin(model, "skin", method="network").feel(data)
    assert touch.force_n == pytest.approx(data.qfrc_constraint.sum(), rel=0.01)
    assert truth_n(touch) == pytest.approx(touch.force_n, rel=0.02)


def test_what_reaches_over_the_border_is_cut_and_counted() -> None:
    touch = felt(body("ball", BALL, 69, 0, 90))  # the rim that cannot be pressed begins there
    assert touch.force_n == pytest.approx(45, abs=1)
    assert touch.lost_n == pytest.approx(45, abs=1)
    assert touch.outside == ()
    assert truth_n(touch) == pytest.approx(touch.force_n, rel=0.1)


def test_a_sheet_of_any_outline_feels_what_lies_within_it() -> None:
    """Of two balls on a plate, one presses where the L-shaped palm has none."""
    palm = load_description("palm_l")
    touch = felt(
        body("on", BALL, -30, -20, 60),
        body("off", BALL, 30, 30, 60),
        description=palm,
        method="fit",
    )
    assert touch.force_n == pytest.approx(60, rel=0.01)
    assert [(each.body, each.where) for each in touch.outside] == [("off", "off the sheet")]
    (contact,) = touch.frame.contacts
    assert (contact.x_m * 1e3, contact.y_m * 1e3) == pytest.approx((-30, -20), abs=1)


def test_contacts_outside_the_sheet_are_named_and_press_nothing() -> None:
    behind = 'type="sphere" size=".02" pos="0 0 -.02"'
    touch = felt(body("finger", BALL, 86, 0, 30), body("strap", behind, 10, 10, 20, -20))
    told = {each.body: (each.where, round(each.force_n)) for each in touch.outside}
    assert told == {"finger": ("off the sheet", 30), "strap": ("behind the sheet", 20)}
    assert (touch.force_n, touch.lost_n) == (0, 0)
    assert not touch.truth_kpa.any()
    assert touch.frame.tier == "quiet"
    assert touch.frame.contacts == ()


def test_nothing_touches_and_nothing_is_felt() -> None:
    touch = felt(body("ball", BALL, 0, 0, 0, 30))
    assert (touch.force_n, touch.frame.contacts, touch.outside) == (0, (), ())


def test_a_site_that_is_not_there_is_told() -> None:
    model, _ = settled()
    with pytest.raises(DataError, match=r"no site 'palm'; add one, or use one of: skin"):
        MujocoSkin(model, "palm")


def test_a_light_touch_is_not_known_rather_than_nothing() -> None:
    touch = felt(body("ball", BALL, 0, 0, 15))  # 122 kPa: below what the sheet answers to
    assert 100 < touch.truth_kpa.max() < 140
    assert touch.frame.pressure_kpa is not None
    assert not np.isfinite(touch.frame.pressure_kpa).all()


@pytest.mark.slow
def test_the_pages_code_runs() -> None:
    page = Page("docs/simulation.md")
    (wears,) = page.blocks("xml")
    feel, observe = page.blocks("python")
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{wears}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    names = {"model": model, "data": data}
    exec(feel, names)
    assert names["touch"].force_n == 0
    exec(observe, names | {"np": np})
    assert names["touch"].frame.pressure_kpa.shape == (51, 51)


CAPSULE = """
<mujoco>
  <option timestep="0.002" gravity="0 0 0"/>
  <default><geom solref=".004 1"/></default>
  <worldbody>
    <body name="arm" pos="0.3 -0.2 0.5" euler="20 40 0">
      <geom name="arm" type="capsule" size=".05 .09"/>
      <site name="skin"/>
      <body name="ball" pos="{pos}">
        <joint type="slide" axis="{axis}" damping="200" stiffness="1e-3" springref="-90e3"/>
        <geom name="ball" type="sphere" size=".03" mass=".1"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def test_a_sheet_around_a_capsule_feels_where_a_ball_presses() -> None:
    """At 40 degrees round the capsule and 20 mm along; the ball slides along the normal there."""
    out = np.array([np.cos(np.radians(40)), np.sin(np.radians(40)), 0.0])
    place = 0.08 * out + [0, 0, 0.02]
    xml = CAPSULE.format(pos=" ".join(map(str, place)), axis=" ".join(map(str, out)))
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, STEPS)
    mount = {"frame": "arm", "cylinder": {"radius_m": 0.05}}
    sensor = variant(load_description("paper_square"), mount=mount)
    touch = MujocoSkin(model, "skin", sensor, method="fit").feel(data)
    assert touch.outside == ()
    assert touch.force_n == pytest.approx(90, rel=0.02)
    assert truth_n(touch) == pytest.approx(touch.force_n, rel=0.02)
    row, column = np.unravel_index(touch.truth_kpa.argmax(), touch.truth_kpa.shape)
    true_m = sensor.map_x_m[column], sensor.map_y_m[row]
    assert true_m == pytest.approx((0.05 * np.radians(40), 0.02), abs=0.003)
    (contact,) = touch.frame.contacts
    assert contact.frame == "arm"
    assert contact.position_m == pytest.approx(0.05 * out + [0, 0, 0.02], abs=2e-3)
    assert contact.normal == pytest.approx(out, abs=0.05)


@pytest.mark.slow
def test_companions_feel_the_force_too() -> None:
    """A load cell of another unit, in the fit of every frame."""
    sensor = load_description("graded_square")
    cell = Companion(gain_n_per_unit=2.0, offset=7.0, noise_n=0.05)
    sensor = sensor.model_copy(update={"companion": {"cell": cell}})
    model, data = settled(body("ball", BALL, 20, -15, 60))
    touch = MujocoSkin(model, "skin", sensor).feel(data)
    told = touch.frame.companions["cell"]
    assert told.state == "fitted"
    assert told.force_n == pytest.approx(touch.force_n, abs=0.3)
    assert sum(one.force_n for one in touch.frame.contacts) == pytest.approx(60, rel=0.05)
