"""Describe a round single sheet with eight electrodes, press a simulated one and find the press.

Run:    .venv/bin/python examples/own_sensor.py
Next:   save DESCRIPTION as my_disc.toml, then `tactomo demo --description my_disc.toml`.
"""

import tomllib

from tactomo_models import Press, Reconstructor, Reference, SensorDescription, SkinSimulator

DESCRIPTION = """
schema = 1
name = "my_disc"
[sheet]
shape = "disc"
width_m = 0.10
conductivity_s_m = 1.0
thickness_m = 1e-4

[electrodes]
count = 8
length_m = 0.006
contact_impedance_ohm_m = 10.0

[pattern]
current_a = 1e-4

[magnitude.response]
pressure_kpa = [0.0, 50.0, 300.0]
relative_change = [0.0, 0.0, 1.0]
"""

skin = SensorDescription.model_validate(tomllib.loads(DESCRIPTION))
simulator = SkinSimulator(skin)
reconstructor = Reconstructor(skin)
reconstructor.set_reference(Reference.from_scans(simulator.voltages([])["magnitude"][None], None))
pressed = simulator.voltages([Press(x_m=0.02, y_m=-0.01, pressure_kpa=200, radius_m=0.01)])
frame = reconstructor.reconstruct(pressed["magnitude"], None)
for c in frame.contacts:
    print(f"{skin.measurements} voltages: a press at {c.x_m * 1e3:.1f}, {c.y_m * 1e3:.1f} mm")
