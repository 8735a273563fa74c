"""How a method is found by its name, and what is said where there is none."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from tactomo_models import (
    ArtifactError,
    MethodError,
    Reconstructor,
    SensorDescription,
    load_description,
)
from tactomo_models.methods.registry import check_method, find_method

MODULE = """
NAN = float("nan")

class NoMethod:
    pass

class NeedsMore:
    @staticmethod
    def check(description):
        raise description_error
    def prepare(self, skin): ...
    def solve(self, measurement, previous, budget_s): ...
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    (tmp_path / "my_methods.py").write_text(MODULE)
    (tmp_path / "broken_methods.py").write_text("1 / 0\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield "my_methods"
    sys.modules.pop("my_methods", None)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("tikonov", "unknown method 'tikonov'; use one of: auto, tikhonov, noser"),
        ("my_methods:", "unknown method"),
        ("nowhere:Mine", "cannot import nowhere: ModuleNotFoundError.*PYTHONPATH"),
        ("my_methods:Mine", "my_methods.py has no Mine; check the name"),
        ("my_methods:NoMethod", r"is no method: it needs prepare\(skin\) and solve"),
    ],
)
def test_what_is_no_method_is_refused_with_the_next_step(module: str, name: str, said: str) -> None:
    with pytest.raises(MethodError, match=said):
        find_method(name)


def test_a_method_says_itself_what_sensor_it_cannot_do(
    module: str, paper: SensorDescription
) -> None:
    check_method("tikhonov", paper)
    found = find_method(f"{module}:NeedsMore")
    sys.modules[module].description_error = ArtifactError("no weights")  # type: ignore[attr-defined]
    assert found.__name__ == "NeedsMore"
    with pytest.raises(ArtifactError, match="no weights"):
        Reconstructor(paper, method=f"{module}:NeedsMore")


@pytest.mark.parametrize("name", ["levelset", "pls-paper"])
def test_a_sensor_without_the_channel_that_a_method_needs_is_told(name: str) -> None:
    graded = load_description("graded_square")
    with pytest.raises(MethodError, match=f"{name}.* needs a structure channel, .*graded_square"):
        check_method(name, graded)
    reconstructor = Reconstructor(graded)
    with pytest.raises(MethodError, match="structure channel"):
        reconstructor.method = name
    assert reconstructor.method == "auto"
    check_method(name, load_description("skin_round"))
    for other in ("auto", "fit", "tikhonov", "noser"):
        check_method(other, graded)
