"""The kinds of arrays that functions take and return; docstrings give their shapes and units."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.intp]
BoolArray: TypeAlias = NDArray[np.bool_]
Image: TypeAlias = NDArray[np.float32]
"""What is published or given to a network: single precision is far finer than the noise."""
