"""The languages that the twin speaks beside ours, by the name of their protocol."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from tactomo.twin.foreign import MakeSpeaker
from tactomo.twin.printing import MatrixBoard, OpenEitBoard

SPEAKERS: Final[Mapping[str, MakeSpeaker]] = {"openeit": OpenEitBoard, "matrix": MatrixBoard}
