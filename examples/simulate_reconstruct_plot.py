"""Simulate two presses on the paper's skin, reconstruct them and plot truth and pressure map.

Run:    .venv/bin/python examples/simulate_reconstruct_plot.py [picture.png]
Needs:  the extra `plot` (`make setup` installs it).
"""

import sys

import numpy as np
from matplotlib.figure import Figure
from tactomo_models import Press, Reconstructor, Reference, SkinSimulator, load_description

picture = sys.argv[1] if len(sys.argv) > 1 else "presses.png"
skin = load_description("paper_square")
simulator = SkinSimulator(skin, unevenness=0.03, impedance_spread=0.1)
presses = [Press(-0.03, 0.02, pressure_kpa=180, radius_m=0.02), Press(0.03, -0.02, 220, 0.02)]

# A converter's noise is equal on every voltage: here 60 dB below their root mean square.
rng = np.random.default_rng(0)
unpressed, pressed = {}, {}
for channel, volts in simulator.voltages([]).items():
    noise_v = 1e-3 * np.sqrt(np.mean(volts**2))
    unpressed[channel] = volts + noise_v * rng.standard_normal((20, len(volts)))
    pressed[channel] = simulator.voltages(presses)[channel]
    pressed[channel] = pressed[channel] + noise_v * rng.standard_normal(len(volts))

reconstructor = Reconstructor(skin)
reconstructor.set_reference(Reference.from_scans(unpressed["magnitude"], unpressed["structure"]))
frame = reconstructor.reconstruct(pressed["magnitude"], pressed["structure"])
for c in frame.contacts:
    print(f"{c.x_m * 1e3:6.1f} {c.y_m * 1e3:6.1f} mm  {c.pressure_kpa:.0f} kPa  {c.force_n:.0f} N")

figure = Figure(figsize=(5, 4), layout="constrained")
axes = figure.subplots()
edge_mm = skin.width_m * 1e3 / 2
image = axes.imshow(frame.pressure_kpa, origin="lower", extent=[-edge_mm, edge_mm] * 2)
axes.plot([p.x_m * 1e3 for p in presses], [p.y_m * 1e3 for p in presses], "r+")
figure.colorbar(image, label="pressure, kPa")
figure.savefig(picture)
