"""The languages that the twin speaks beside ours, by the name of their protocol."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from tactomo.twin.foreign import MakeSpeaker
from tactomo.twin.printing import MatrixBoard, OpenEitBoard
from tactomo.twin.sciospec import SciospecSpeaker

SPEAKERS: Final[Mapping[str, MakeSpeaker]] = {
    "sciospec": SciospecSpeaker,
    "openeit": OpenEitBoard,
    "matrix": MatrixBoard,
}
