"""The package opens with a map of its folders; none is missing on it, and none is gone."""

from __future__ import annotations

import pkgutil
import re

import tactomo_models


def test_every_folder_is_on_the_map() -> None:
    assert tactomo_models.__doc__
    table = re.search(r"^=+ +=+\n(.*)^=+ +=+\n", tactomo_models.__doc__, re.M | re.S)
    assert table
    told = [row.split()[0] for row in table[1].splitlines()]
    there = {found.name for found in pkgutil.iter_modules(tactomo_models.__path__) if found.ispkg}
    assert sorted(told) == sorted(there)
