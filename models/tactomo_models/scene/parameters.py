"""Parameters of a contact: the columns that they stand in, and what is likely of them."""

from __future__ import annotations

import numpy as np

UNIT_M = 0.01  # positions are counted in this, so that all parameters are of order 1
# Columns of a contact's parameters: place, form, peak pressure in units of the field, edge, hole.
X, Y, SIZE, E1, E2, HARMONIC, PEAK, EDGE, HOLE, COLUMNS = 0, 1, 2, 3, 4, 5, 9, 10, 11, 12
TYPICAL_SIZE = float(np.log(0.012))  # s is the logarithm of the mean radius in metres
SMALLEST_SIZE = float(np.log(0.003))  # of a mean radius: the distance of two nodes
MAX_BULGE = 0.25
# Of an edge that is not flat: what falls less shows nothing but the sheet's errors.
EDGE_LIMITS = (0.3, 1.0)
HERTZ = 0.5
FALLING_SHARE = 0.3  # of presses, before any data: see `methods.kinds.SHARES`
# Of a peak, in units of the table's end: less leaves nothing to fit, beyond the table all that is
# told is a lower bound.
PEAK_LIMITS = (0.01, 3.0)
# Place, size, elongation and bulges; the peak half of the table, which is made for such presses
# (all of it loses 0.003 of the correlation on mixed presses, 0.3 on ordinary ones); edges as of
# balls and fingers, holes of what presses with its rim.
PRIOR_SIGMA = np.array([5.0, 5.0, 0.6, 0.3, 0.3, 0.05, 0.05, 0.07, 0.07, 0.5, 0.12, 0.5])
