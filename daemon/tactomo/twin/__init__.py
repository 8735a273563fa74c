"""The twin: a simulated skin behind simulated firmware, on real pseudo-terminals.

A product, not a test helper: whoever writes a robot controller, a daemon or a firmware gets a
device to work against that can be pressed, disturbed and unplugged. The daemon cannot tell it
from hardware, except by the device's name, which starts with "twin", and by the SIMULATED flag of
every scan.

::

    twin = Twin(TwinConfig(load_description("paper_square")))
    twin.start()
    print(twin.ports, twin.control)
    twin.stop()
"""

from tactomo.twin.device import Twin, TwinConfig, make_skin
from tactomo.twin.scene import Indenter, Scene, ScriptedPress, Waypoint, load_scene

__all__ = [
    "Indenter",
    "Scene",
    "ScriptedPress",
    "Twin",
    "TwinConfig",
    "Waypoint",
    "load_scene",
    "make_skin",
]
