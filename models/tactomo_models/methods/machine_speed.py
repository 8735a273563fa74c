"""What a budget of time buys on the machine at hand: how much modelled work.

A reconstructor's budget counts modelled work, so that a recording reconstructs exactly as the live
stream did (`field_fit.Budget`). The machine's speed turns time into such a budget, once, before the
reconstructor is given it and before it is recorded: a replay needs no such measure, and takes the
same steps on any machine.

It is measured by `tactomo bench --machine-speed` and kept beside the sensor's artifact. Where
there is none, one that comes with tactomo stands in.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Mapping
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tactomo_models.archive import write_whole
from tactomo_models.errors import ArtifactError, explain
from tactomo_models.foreign_file import MAX_TEXT_BYTES, read_regular
from tactomo_models.physics.artifact import default_path
from tactomo_models.sensor.description import SensorDescription

SHIPPED: Final = "shipped_machine_speed.json"
AGAIN: Final = "run: tactomo bench --machine-speed"
MIN_BUDGET_S: Final = 0.001  # a frame does one thing at least, whatever it may take


class MachineSpeed(BaseModel):
    """What was measured for one sensor on one machine."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    format: Literal[2] = 2  # of the file
    tactomo: str  # the version that measured
    machine: str  # its processor
    taken: str  # the day, as YYYY-MM-DD
    sensor: str  # name of the description
    sha256: str  # that description's hash
    # time of a frame, at its 99th percentile, that goes by no budget
    overhead_s: Annotated[float, Field(ge=0)]
    # seconds that a frame takes for each second of modelled work, there
    speed: Annotated[float, Field(gt=0)]
    shipped: Annotated[bool, Field(exclude=True)] = False  # whether it came with tactomo

    @classmethod
    def of_times(
        cls,
        description: SensorDescription,  # the sensor
        taken: str,  # the day
        p99_s: Mapping[float, float],  # time of a frame, at its 99th percentile, by its budget
    ) -> MachineSpeed:
        """Make one of what was measured just now on this machine."""
        overhead_s, speed = _law(p99_s)
        return cls(
            tactomo=version("tactomo"),
            machine=processor(),
            taken=taken,
            sensor=description.name,
            sha256=description.sha256,
            overhead_s=overhead_s,
            speed=speed,
        )

    def budget_s(self, time_s: float) -> float:
        """Modelled work (s) by which 99 frames of 100 keep to a time (s)."""
        return max(MIN_BUDGET_S, (time_s - self.overhead_s) / self.speed)

    @property
    def source(self) -> str:
        """In words, where it comes from."""
        if self.shipped:
            return f"shipped, of {self.machine}; {AGAIN}"
        return f"measured here on {self.taken}"


def _law(p99_by_budget: Mapping[float, float]) -> tuple[float, float]:
    """Overhead and slope of the frames' time over their budget, by least relative squares."""
    budget_s, p99_s = np.array([*p99_by_budget]), np.array([*p99_by_budget.values()])
    terms = np.stack([np.ones(len(budget_s)), budget_s], axis=1)
    from scipy.optimize import nnls  # 10 MB, which a daemon need not hold

    (overhead_s, speed), _ = nnls(terms / p99_s[:, None], np.ones(len(budget_s)))
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
        content = read_regular(path, MAX_TEXT_BYTES)
        found = MachineSpeed.model_validate_json(content)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ArtifactError(f"cannot read {path}: {error.strerror}; {AGAIN}") from error
    except ValidationError as error:
        if _is_earlier(content):
            raise ArtifactError(f"{path} was measured by an earlier tactomo; {AGAIN}") from error
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
    return found


def _is_earlier(content: bytes) -> bool:
    """Whether a file is of format 1, which rated methods beside the machine's speed."""
    try:
        return dict(json.loads(content)).get("format") == 1
    except (ValueError, TypeError):
        return False


def _shipped() -> MachineSpeed:
    text = files("tactomo_models.methods").joinpath(SHIPPED).read_text("utf-8")
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
