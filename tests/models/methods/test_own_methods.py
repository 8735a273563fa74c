"""A method of the user's own: it works like ours, and what is wrong with it is named."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tactomo_models import (
    Estimate,
    Flag,
    Measurement,
    MethodError,
    Press,
    Reconstruction,
    Reconstructor,
    Reference,
    SensorDescription,
    Skin,
    SkinSimulator,
    UnsolvableError,
)
from tactomo_models.arrays import FloatArray

Answer = Callable[[FloatArray], Any]


class Own:
    """Answers what a test wants, made of an image of one bright node."""

    def __init__(self, answer: Answer) -> None:
        self._answer = answer
        self.previous: list[Estimate | None] = []

    def prepare(self, skin: Skin) -> None:
        shape = (skin.description.map.nodes_y, skin.description.map.nodes_x)
        self._image = np.zeros(shape)
        self._image[2:6, 2:6] = 0.2

    def solve(self, measurement: Measurement, previous: Estimate | None, budget_s: float) -> Any:
        self.previous.append(previous)
        return self._answer(self._image)


@pytest.fixture(scope="module")
def volts(small: SensorDescription) -> tuple[Any, Any]:
    """Voltages at rest and pressed."""
    skin = SkinSimulator(small)
    return skin.voltages([]), skin.voltages([Press(0.005, 0.0, 150.0, 0.006)])


def frames(
    small: SensorDescription, volts: tuple[Any, Any], method: Own, count: int = 1
) -> list[Reconstruction]:
    rest, pressed = volts
    reconstructor = Reconstructor(small, method=method)
    reconstructor.set_reference(Reference(rest["magnitude"], rest["structure"]))
    return [
        reconstructor.reconstruct(pressed["magnitude"], pressed["structure"]) for _ in range(count)
    ]


def refuse(image: FloatArray) -> Estimate:
    raise UnsolvableError("no voltage is large enough")


def test_a_method_may_find_nothing_to_solve(
    small: SensorDescription, volts: tuple[Any, Any]
) -> None:
    (frame,) = frames(small, volts, Own(refuse))
    assert (frame.tier, frame.failure) == ("tikhonov", "")
    assert frame.reason == "no voltage is large enough"


@pytest.mark.parametrize(
    ("answer", "cause"),
    [
        (lambda image: 1 / 0, "ZeroDivisionError"),
        (lambda image: None, "returned NoneType, not Estimate"),
        (lambda image: Estimate(), "neither map nor structure"),
        (lambda image: Estimate(map=image[1:]), "map has shape"),
        (lambda image: Estimate(structure=image.tolist()), "structure is no array"),
        (lambda image: Estimate(map=image / 0), "not finite"),
        (lambda image: Estimate(map=image, magnitudes=np.ones(7)), "without their areas"),
        (lambda image: Estimate(map=image, made_by=3), "text"),  # type: ignore[arg-type]
        (lambda image: Estimate(map=image, misfit="x"), "numbers"),  # type: ignore[arg-type]
    ],
)
@pytest.mark.filterwarnings("ignore:.*encountered in divide")
def test_what_fails_is_named_and_the_frame_goes_on(
    small: SensorDescription, volts: tuple[Any, Any], answer: Answer, cause: str
) -> None:
    own = Own(answer)
    first, second = frames(small, volts, own, 2)
    for frame in (first, second):
        assert frame.tier == "tikhonov"
        assert frame.map is not None
        assert frame.failure.startswith("method Own failed: ")
        assert cause in frame.failure
        assert frame.reason == frame.failure
        assert not frame.flags & Flag.NO_REFERENCE
    assert own.previous == [None, None]


MODULE = """
class Needy:
    def __init__(self, more): ...
    def prepare(self, skin): ...
    def solve(self, measurement, previous, budget_s): ...
"""


@pytest.mark.slow
def test_a_module_is_found_in_the_working_folder(tmp_path: Path) -> None:
    (tmp_path / "needy.py").write_text(MODULE)
    program = (
        "import sys; sys.path.remove('')\n"  # as the `tactomo` script runs
        "from tactomo_models.methods.registry import find_method\n"
        "print(find_method('needy:Needy').__name__)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout == "Needy\n"


def test_a_class_that_needs_arguments_is_no_method(
    small: SensorDescription, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "needy.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    reconstructor = Reconstructor(small)
    with pytest.raises(MethodError, match=r"needy:Needy' cannot be made.*without arguments"):
        reconstructor.method = "needy:Needy"


def test_the_mesh_has_the_jacobians_nodes_and_a_laplace_prior(small: SensorDescription) -> None:
    skin = Skin.of(small)
    mesh = skin.mesh
    assert len(mesh.nodes_m) == len(mesh.areas_m2) == skin.artifact.jacobian.shape[1]
    assert mesh.electrodes_m.shape == (small.electrode_count, 2)
    one, two = (
        mesh.nodes_m[mesh.triangles[:, k]] - mesh.nodes_m[mesh.triangles[:, 0]] for k in (1, 2)
    )
    area = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]).sum() / 2
    slope = mesh.nodes_m @ [3.0, -4.0] + 1  # |gradient| 5
    assert slope @ (mesh.smoothness() @ slope) == pytest.approx(25 * area)
