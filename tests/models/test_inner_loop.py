"""What Python lends to the compiled inner loop, and what is said where there is none."""

from __future__ import annotations

import weakref
from pathlib import Path

import numpy as np
import pytest
from tactomo_models import inner_loop
from tactomo_models.errors import ModelError
from tactomo_models.inner_loop import LIBRARY, at
from tactomo_models.physics.forward import ForwardModel


def test_what_c_is_given_lives_as_long_as_its_address() -> None:
    """A property's array has nobody else: C once read what was freed."""
    array = np.arange(3)
    alive = weakref.ref(array)
    address = at(array)
    del array
    assert alive() is not None
    del address
    assert alive() is None


@pytest.mark.parametrize("state", ["is missing", "is not of this machine and version"])
def test_a_library_that_cannot_be_used_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, forward: ForwardModel, state: str
) -> None:
    library = tmp_path / "libinner_loop.so"
    if state != "is missing":
        library.write_bytes(b"not of this machine")
    monkeypatch.setattr(inner_loop, "_PATH", library)
    for name in [*vars(LIBRARY)]:
        monkeypatch.delattr(LIBRARY, name)  # as in a process that has not used it yet
    with pytest.raises(ModelError, match=f"{state}.*install tactomo again"):
        ForwardModel(forward.description, forward.bare)


def test_a_library_of_another_source_is_not_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, forward: ForwardModel
) -> None:
    """Its arrays may lie elsewhere: the process would die without a word."""
    newer = tmp_path / "inner_loop.c"
    newer.write_text("/* changed since */")
    monkeypatch.setattr(inner_loop, "_SOURCE", newer)
    for name in [*vars(LIBRARY)]:
        monkeypatch.delattr(LIBRARY, name)
    with pytest.raises(ModelError, match=r"has changed since.*install tactomo again"):
        ForwardModel(forward.description, forward.bare)
