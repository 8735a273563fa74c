"""A tactomo sensor as a camera of LeRobot: `--robot.cameras='{skin: {type: tactomo, ...}}'`.

Installed beside LeRobot, it is found by its package's name.
"""

from lerobot_camera_tactomo.camera import TactomoCamera, TactomoCameraConfig

__all__ = ["TactomoCamera", "TactomoCameraConfig"]
