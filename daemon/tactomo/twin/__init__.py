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

The parts: `scene` (what presses, by script), `surface` (what presses now), `firmware` (the
microcontroller), `converter` (noise, drift, counts), `line` (the serial line), `control` (its
control socket) and `device`, which puts them together. In the skin's place there may be measured
frames (`playing`), and in the firmware's another instrument (`foreign`, and an emulator of each
protocol).
"""

from tactomo.twin.device import SkinModel, Twin, TwinConfig, make_skin
from tactomo.twin.scene import Indenter, Scene, ScriptedPress, Waypoint, load_scene

__all__ = [
    "Indenter",
    "Scene",
    "ScriptedPress",
    "SkinModel",
    "Twin",
    "TwinConfig",
    "Waypoint",
    "load_scene",
    "make_skin",
]
