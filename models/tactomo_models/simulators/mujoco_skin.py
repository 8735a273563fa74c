"""A skin on a robot in MuJoCo: its contacts become pressure, voltages and a reconstruction.

MuJoCo's contacts are points with forces. Each is spread over the sheet as a ball presses an elastic
layer (Hertz): with the force F, the ball's radius R and the layer's effective modulus E* the
pressure is p0 (1 - r²/a²)^½ within a = (3 F R / 4 E*)^⅓, where p0 = 3 F / 2 π a². Where contacts
overlap pressures add. A layer that is not deep against `a`, and bodies that are no balls, press
otherwise; the force is kept all the same. What reaches over the border of the area that can be
pressed is cut off and counted; a contact that is off the sheet or behind it is named, and presses
nothing. Shear is not felt: a sheet's conductivity answers to pressure.

The pressure makes both sheets' voltages on another mesh than the one that reconstructs, with an
uneven sheet and noise; companions feel the force at once, with their noise. Source: K. L. Johnson,
Contact Mechanics (1985), section 4.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from tactomo_protocol import Channel
from threadpoolctl import ThreadpoolController

from tactomo_models.arrays import FloatArray, Image
from tactomo_models.errors import DataError
from tactomo_models.reconstruct import Reconstructor
from tactomo_models.scans.reference import Reference
from tactomo_models.scene.areas import AreaFinder
from tactomo_models.scene.press import Press
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.sensor.description import SensorDescription
from tactomo_models.sensor.description_file import load_description
from tactomo_models.simulation.simulator import SkinSimulator, noisy

MODULUS_PA: Final = 1e6
"""Effective modulus of the cover: soft rubber and foams have 0.3 to 3 MPa. Twice as stiff, contacts
are 21 % narrower and their peaks 59 % higher."""
RADIUS_M: Final = 0.01
"""Of what has no round shape; contacts grow with its cube root."""
REACH_M: Final = 0.01
"""Contacts further from the sheet's plane are another side's; bodies sink in by less."""
FACING: Final = 0.5
"""Least cosine between a contact's normal and the sheet's: up to 60°."""
REFERENCE_SCANS: Final = 20
"""As the daemon's tare takes."""
DISC_POINTS: Final = 400
"""To find a contact's share beyond the border: to a few thousandths."""


@dataclass(frozen=True)
class Outside:
    """A contact with the skin's body that presses nothing.

    Attributes:
        body: the name of what touches there; "geom 7" where it has none.
        force_n: its normal force.
        where: beside the area that can be pressed, or on another side of the body.
    """

    body: str
    force_n: float
    where: Literal["off the sheet", "behind the sheet"]


@dataclass(frozen=True)
class Touch:
    """What a skin feels at an instant, and the truth beside it.

    Attributes:
        frame: what is reconstructed from the voltages.
        truth_kpa: (nodes_y, nodes_x) the pressure that made them.
        force_n: normal force on the area that can be pressed.
        lost_n: normal force of contacts there that reaches over its border.
        outside: contacts that press nothing.
    """

    frame: Reconstruction
    truth_kpa: Image
    force_n: float
    lost_n: float
    outside: tuple[Outside, ...]


class MujocoSkin:
    """The skin at a site of a MuJoCo model, on the body that has the site.

    Args:
        model: the `mujoco.MjModel`.
        site: its name. The site is the sheet's middle on the pressed side: x to the right, y up, z
            out of the sheet. With a description that has a mount, the site is the origin of the
            mount's frame, and the sheet lies around it as the mount says.
        description: the sensor, or the name of a shipped one.
        modulus_pa: effective modulus of what covers the sheet.
        radius_m: of whatever touches and is no sphere, capsule or cylinder.
        noise: rms of the converter's noise as a share of the bare sheet's rms voltage.
        unevenness, impedance_spread, seed: of the simulated sheet, see `SkinSimulator`.
        **options: of the `Reconstructor`, such as ``method="network"``.

    Raises:
        DataError: the model has no such site.
        ModelError: the description or an option cannot be used.
    """

    def __init__(
        self,
        model: Any,
        site: str,
        description: SensorDescription | str = "paper_square",
        *,
        modulus_pa: float = MODULUS_PA,
        radius_m: float = RADIUS_M,
        noise: float = 1e-3,
        unevenness: float = 0.03,
        impedance_spread: float = 0.1,
        seed: int = 0,
        **options: Any,
    ) -> None:
        import mujoco

        self._mujoco = mujoco
        self._model = model
        self._site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, site)
        if self._site < 0:
            known = ", ".join(model.site(n).name for n in range(model.nsite)) or "none"
            raise DataError(f"the model has no site {site!r}; add one, or use one of: {known}")
        if isinstance(description, str):
            description = load_description(description)
        self.description = description
        self._modulus_pa, self._radius_m, self._noise = modulus_pa, radius_m, noise
        self._rng = np.random.default_rng(seed)
        self._blas = ThreadpoolController()
        self._simulator = SkinSimulator(
            description, unevenness=unevenness, impedance_spread=impedance_spread, seed=seed
        )
        self._nodes = AreaFinder(self._simulator.forward)
        self._bare = self._simulator.voltages([])
        self._reconstructor = Reconstructor(description, **options)
        scans = [self._noisy(self._bare) for _ in range(REFERENCE_SCANS)]
        tare = {name: np.array([scan[name] for scan in scans]) for name in self._bare}
        self._reconstructor.set_reference(
            Reference.from_scans(tare.get(Channel.MAGNITUDE), tare.get(Channel.STRUCTURE))
        )

    def reset(self) -> None:
        """Forget the last frames, as when the robot is put elsewhere."""
        self._reconstructor.reset()

    def feel(self, data: Any) -> Touch:
        """Return what the skin feels of a `mujoco.MjData` that has been stepped."""
        with self._blas.limit(limits=1):  # matrices too small to share: more threads only spin
            return self._feel(data)

    def _feel(self, data: Any) -> Touch:
        presses, lost_n, outside = self._presses(data)
        x, y = self._nodes.places
        pressure, coverage = np.zeros_like(x), np.zeros_like(x)
        force_n = 0.0
        for press, pressed_n in presses:
            covered = press.coverage(x, y, self._simulator.spacing_m)
            own = press.pressure_at(x, y) * covered
            on_nodes_n = 1e3 * float(own @ self._nodes.node_areas_m2)
            pressure += own * (pressed_n / on_nodes_n)  # a mesh keeps no force by itself
            coverage = np.maximum(coverage, covered)
            force_n += pressed_n
        under = np.divide(pressure, coverage, out=np.zeros_like(x), where=coverage > 0)
        volts = self._simulator.voltages_under(under, coverage) if presses else self._bare
        scan = self._noisy(volts)
        frame = self._reconstructor.reconstruct(
            scan.get(Channel.MAGNITUDE),
            scan.get(Channel.STRUCTURE),
            companions=self._readings(self._simulator.forces_under(under, coverage)),
        )
        truth_kpa = self.description.shown(self._nodes.on_map(pressure))
        return Touch(frame, truth_kpa, force_n, lost_n, outside)

    def _noisy(self, volts: dict[Channel, FloatArray]) -> dict[Channel, FloatArray]:
        noise_v = {name: self._noise * np.sqrt(np.mean(v**2)) for name, v in self._bare.items()}
        return noisy(volts, noise_v, self._rng)

    def _readings(self, forces_n: dict[str, float]) -> list[tuple[str, float]]:
        """What companions read, each in its own unit."""
        known = self.description.companion
        return [
            (name, known[name].reading_of(self._rng.normal(force_n, known[name].noise_n)))
            for name, force_n in forces_n.items()
        ]

    def _presses(self, data: Any) -> tuple[list[tuple[Press, float]], float, tuple[Outside, ...]]:
        """Return what presses and its force, the force over the border, and what is outside."""
        turned = data.site_xmat[self._site].reshape(3, 3)
        middle = data.site_xpos[self._site]
        presses: list[tuple[Press, float]] = []
        outside: list[Outside] = []
        lost_n = 0.0
        for contact, normal, other, force_n in self._contacts(data):
            (x, y), height, out = self._on_sheet((contact.pos - middle) @ turned)
            if -(normal @ turned) @ out < FACING or abs(height) > REACH_M:
                outside.append(Outside(self._name(other), force_n, "behind the sheet"))
                continue
            press = self._press(x, y, force_n, self._roundness(other))
            share = self._share_on_sheet(press)
            if share == 0:
                outside.append(Outside(self._name(other), force_n, "off the sheet"))
                continue
            presses.append((press, share * force_n))
            lost_n += (1 - share) * force_n
        return presses, lost_n, tuple(outside)

    def _on_sheet(self, point_m: FloatArray) -> tuple[FloatArray, float, FloatArray]:
        """Return the place on the sheet below a point of the site's frame, height, and normal."""
        mount = self.description.mount
        if mount is None:
            return point_m[:2], float(point_m[2]), np.array([0.0, 0.0, 1.0])
        place, height = mount.unplace(point_m[None])
        return place[0], float(height[0]), mount.place(place)[1][0]

    def _contacts(self, data: Any) -> Any:
        """Yield each contact with the body, its normal towards that, the other geom, the force."""
        body = self._model.site_bodyid[self._site]
        wrench = np.zeros(6)
        for number in range(data.ncon):
            contact = data.contact[number]
            first, second = (int(geom) for geom in contact.geom)
            owners = [self._model.geom_bodyid[g] if g >= 0 else -1 for g in (first, second)]
            if body not in owners:
                continue
            self._mujoco.mj_contactForce(self._model, data, number, wrench)
            if wrench[0] > 0:
                is_second = owners[1] == body  # the normal points from the first to the second
                normal = contact.frame[:3] if is_second else -contact.frame[:3]
                yield contact, normal, first if is_second else second, float(wrench[0])

    def _press(self, x_m: float, y_m: float, force_n: float, radius_m: float) -> Press:
        a = (3 * force_n * radius_m / (4 * self._modulus_pa)) ** (1 / 3)
        a = max(a, self._simulator.spacing_m)  # less than the mesh can show
        peak_kpa = 3 * force_n / (2 * np.pi * a**2) * 1e-3
        stretching = self.description.stretching
        if stretching is None:
            return Press(float(x_m), float(y_m), peak_kpa, a, profile="dome")
        # A circle on the surface is an ellipse on the sheet.
        times, axes = np.linalg.eigh(stretching.stretch_of(np.array([[[x_m, y_m]]]))[0])
        a_x, a_y = (a / times).tolist()
        angle = float(np.arctan2(*axes[::-1, 0]))
        return Press(float(x_m), float(y_m), peak_kpa, a_x, a_y, angle, profile="dome")

    def _share_on_sheet(self, press: Press) -> float:
        """Share of a contact's force on the area that can be pressed.

        On a spiral of points that each stand for the same force.
        """
        step = np.arange(DISC_POINTS) + 0.5
        radius = press.radius_m * np.sqrt(1 - (1 - step / DISC_POINTS) ** (2 / 3))
        angle = step * np.pi * (3 - 5**0.5)
        x, y = press.x_m + radius * np.cos(angle), press.y_m + radius * np.sin(angle)
        margin_m = self.description.sheet.frame_width_m
        return float(np.mean(self.description.on_sheet(x, y, margin_m)))

    def _roundness(self, geom: int) -> float:
        """Return the radius of a geom."""
        kinds = self._mujoco.mjtGeom
        is_round = {int(kinds.mjGEOM_SPHERE), int(kinds.mjGEOM_CAPSULE), int(kinds.mjGEOM_CYLINDER)}
        if geom >= 0 and int(self._model.geom_type[geom]) in is_round:
            return float(self._model.geom_size[geom][0])
        return self._radius_m

    def _name(self, geom: int) -> str:
        return "a flex" if geom < 0 else self._model.geom(geom).name or f"geom {geom}"
