"""The fit of old: every contact presses evenly, from rim to rim."""

from __future__ import annotations

from tactomo_models.methods.fit import OutlineFit


class EvenFit(OutlineFit):
    """The pressure field without its edge and its hole."""

    questions = ()
