"""Where on the robot a sensor is: the frame that it hangs on, and its pose in there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Self

WORLD: Final = "world"


@dataclass(frozen=True, slots=True)
class Placement:
    """A sensor's pose in its parent frame; metres, and angles in degrees about the fixed axes.

    The sensor's own frame has its origin at the sheet's centre, x to the right, y up and z out of
    the pressed side, towards whoever presses.
    """

    parent: str = WORLD
    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0

    @classmethod
    def parse(cls, parent: str, pose: str) -> Self:
        """Return the placement that "X,Y,Z" (m) or "X,Y,Z,ROLL,PITCH,YAW" (m, degrees) means.

        Raises:
            ValueError: it is neither.
        """
        numbers = [float(number) for number in pose.split(",")]
        if len(numbers) not in (3, 6) or not all(math.isfinite(number) for number in numbers):
            raise ValueError("give X,Y,Z or X,Y,Z,ROLL,PITCH,YAW, in metres and degrees")
        return cls(parent, *numbers)

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """The rotation as (x, y, z, w): about x by the roll, then y by the pitch, then z."""
        angles = (self.roll_deg, self.pitch_deg, self.yaw_deg)
        (sr, cr), (sp, cp), (sy, cy) = (
            (math.sin(half), math.cos(half)) for half in (math.radians(a) / 2 for a in angles)
        )
        return (
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        )
