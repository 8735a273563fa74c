"""The package opens with a map of its modules; none is missing on it, and none is gone."""

from __future__ import annotations

import pkgutil
import re

import tactomo_models

DATA = {"sensors"}


def test_every_module_is_on_the_map() -> None:
    assert tactomo_models.__doc__
    table = re.search(r"^=+ +=+\n(.*)^=+ +=+\n", tactomo_models.__doc__, re.M | re.S)
    assert table
    rows = [row[17:].partition(":")[0] for row in table[1].splitlines()]
    told = [name for row in rows for name in row.split(", ")]
    there = {module.name for module in pkgutil.iter_modules(tactomo_models.__path__)}
    assert sorted(told) == sorted(there - DATA)
