"""What a budget of time buys on the machine at hand: how much work, and which method.

A reconstructor's budget counts modelled work, so that a recording reconstructs exactly as the live
stream did (`field_fit.Budget`). The machine's speed turns time into such a budget, once, before the
reconstructor is given it and before it is recorded: a replay needs no such measure, and takes the
same steps on any machine.

It is measured by `tactomo bench --machine-speed` and kept beside the sensor's artifact. Where
there is none, one that comes with tactomo stands in.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tactomo_models.archive import write_whole
from tactomo_models.errors import ArtifactError, ModelError, explain
from tactomo_models.methods.registry import check_method
from tactomo_models.physics.artifact import default_path
from tactomo_models.sensor.description import SensorDescription

SHIPPED: Final = "shipped_machine_speed.json"
AGAIN: Final = "run: tactomo bench --machine-speed"
CLEARLY: Final = 0.02  # of ICC: by more than this another method must be better than auto's own
MIN_BUDGET_S: Final = 0.001  # a frame does one thing at least, whatever it may take


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Row(_Table):
    """How fast and how right a method is on moving scenes, frame after frame."""

    method: str  # its name
    # modelled work that a frame might take; None where a method takes what it takes
    budget_s: Annotated[float, Field(gt=0)] | None
    # p50_s, p99_s: time of a frame
    p50_s: Annotated[float, Field(gt=0)]
    p99_s: Annotated[float, Field(gt=0)]
    # of the magnitude map, mean, on the laboratory's moving scenes of the shipped sensor: no matter
    # of the machine, and the order of methods on other sensors, too
    icc: Annotated[float, Field(ge=-1, le=1)]


class Plan(NamedTuple):
    """What a reconstructor is given for the method and the time that were asked for."""

    method: str
    budget_s: float | None


class MachineSpeed(_Table):
    """What was measured for one sensor on one machine."""

    format: Literal[1] = 1  # of the file
    tactomo: str  # the version that measured
    machine: str  # its processor
    taken: str  # the day, as YYYY-MM-DD
    sensor: str  # name of the description
    sha256: str  # that description's hash
    # time of a frame, at its 99th percentile, that goes by no budget
    overhead_s: Annotated[float, Field(ge=0)]
    # seconds that a frame takes for each second of modelled work, there
    speed: Annotated[float, Field(gt=0)]
    rows: tuple[Row, ...]  # the methods that `auto` may choose from
    shipped: Annotated[bool, Field(exclude=True)] = False  # whether it came with tactomo

    @classmethod
    def of_rows(
        cls,
        description: SensorDescription,  # the sensor
        taken: str,  # the day
        rows: Sequence[Row],  # some of them of `auto`, under different budgets
    ) -> MachineSpeed:
        """Make one of what was measured just now on this machine."""
        overhead_s, speed = _law([row for row in rows if row.method == "auto"])
        return cls(
            tactomo=version("tactomo"),
            machine=processor(),
            taken=taken,
            sensor=description.name,
            sha256=description.sha256,
            overhead_s=overhead_s,
            speed=speed,
            rows=tuple(rows),
        )

    def plan(self, method: str, time_s: float | None) -> Plan:
        """Return what to give a reconstructor, so that 99 frames of 100 keep to a time.

        Args:
            method: that is asked for. `auto` becomes another method where that one is more right
                within so little time.
            time_s: that a frame may take; None leaves it to the method.
        """
        if time_s is None:
            return Plan(method, None)
        best = self.best_within(time_s) if method == "auto" else None
        budget_s = max(MIN_BUDGET_S, (time_s - self.overhead_s) / self.speed)
        return Plan(method if best is None else best.method, budget_s)

    def best_within(self, time_s: float) -> Row | None:
        """Return the most accurate row that keeps to a time, or else the fastest one.

        What `auto` does by itself is judged by the physics and flagged where that finds fault, so
        that another method has to be clearly more accurate.
        """
        fitting = [row for row in self.rows if row.p99_s <= time_s]
        if fitting:
            return max(fitting, key=lambda row: row.icc + CLEARLY * (row.method == "auto"))
        return min(self.rows, key=lambda row: row.p99_s, default=None)

    @property
    def source(self) -> str:
        """In words, where it comes from."""
        if self.shipped:
            return f"shipped, of {self.machine}; {AGAIN}"
        return f"measured here on {self.taken}"


def _law(rows: Sequence[Row]) -> tuple[float, float]:
    """Overhead and slope of the frames' time over their budget, by least relative squares."""
    budget_s = np.array([row.budget_s or 0.0 for row in rows])
    p99_s = np.array([row.p99_s for row in rows])
    terms = np.stack([np.ones(len(rows)), budget_s], axis=1)
    from scipy.optimize import nnls  # 10 MB, which a daemon need not hold

    (overhead_s, speed), _ = nnls(terms / p99_s[:, None], np.ones(len(rows)))
    return float(overhead_s), max(float(speed), 1e-3)


def machine_speed_path(description: SensorDescription) -> Path:
    """Where what was measured for a sensor is kept: beside its artifact."""
    return default_path(description).with_suffix(".speed.json")


def save_machine_speed(measured: MachineSpeed, path: Path) -> None:
    """Write what was measured; a half-written one is never left under that name.

    Raises ArtifactError where the file cannot be written.
    """
    content = (measured.model_dump_json(indent=1) + "\n").encode()
    try:
        write_whole(path, lambda file: file.write(content))
    except OSError as error:
        raise ArtifactError(f"cannot write {path}: {error.strerror}; free some space") from error


def load_machine_speed(path: Path, description: SensorDescription) -> MachineSpeed:
    """Read what was measured and make sure that it holds here.

    Raises:
        ArtifactError: it is damaged, or of another machine, sensor or version of tactomo.
        FileNotFoundError: there is none.
    """
    try:
        found = MachineSpeed.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ArtifactError(f"cannot read {path}: {error.strerror}; {AGAIN}") from error
    except ValidationError as error:
        complaint = " ".join(explain(error.errors()[0]).split())[:200]
        raise ArtifactError(f"{path} is damaged ({complaint}); {AGAIN}") from error
    for what, of, here in (
        ("on", found.machine, processor()),
        ("for", found.sha256, description.sha256),
        ("by tactomo", found.tactomo, version("tactomo")),
    ):
        if of != here:
            raise ArtifactError(
                f"{path} was measured {what} {of[:60]}, not {what} {here[:60]}; {AGAIN}"
            )
    return found


def machine_speed_for(
    description: SensorDescription,  # the sensor
    warn: Callable[[str], None],  # told in one line why what was measured here is not used
) -> MachineSpeed:
    """What is in force: what was measured here, or else what comes with tactomo."""
    try:
        found = load_machine_speed(machine_speed_path(description), description)
    except FileNotFoundError:
        found = _shipped()
    except ArtifactError as error:
        warn(f"{error}; until then: the one that comes with tactomo")
        found = _shipped()
    # Which method is best is another sensor's, and a network may be gone that was there.
    of_this = (found.sensor, found.sha256) == (description.name, description.sha256)
    rows = [row for row in found.rows if of_this and _is_available(description, row.method)]
    return found.model_copy(update={"rows": tuple(rows)})


def shipped_rows(description: SensorDescription) -> list[Row]:
    """Rows of the shipped table whose methods a sensor can be reconstructed by."""
    return [row for row in _shipped().rows if _is_available(description, row.method)]


def _is_available(description: SensorDescription, method: str) -> bool:
    try:
        check_method(method, description)
    except ModelError:
        return False
    return True


def _shipped() -> MachineSpeed:
    text = files("tactomo_models").joinpath(SHIPPED).read_text("utf-8")
    return MachineSpeed.model_validate_json(text).model_copy(update={"shipped": True})


@cache
def processor() -> str:
    """Name of this machine's processor."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(": ")[2]
    return platform.processor() or platform.machine()
