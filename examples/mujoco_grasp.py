"""A simulated gripper squeezes a ball on a skin and rolls it: the truth, and what the skin feels.

Run:    MUJOCO_GL=egl .venv/bin/python examples/mujoco_grasp.py     (draws grasp.png)
Needs:  the extras `mujoco` and `plot`: pip install 'tactomo[mujoco,plot]'
"""

import time
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.figure import Figure
from tactomo_models.simulators.mujoco_skin import MujocoSkin

model = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("gripper.xml")))
data = mujoco.MjData(model)
skin = MujocoSkin(model, site="skin", budget_s=0.006)  # of work, for 50 frames a second
touches, began_s = [], time.process_time()
for step in range(1000):  # two seconds; the skin has 50 frames in each
    data.ctrl[:] = min(90, step / 4), max(0, step - 400) * 2e-4  # N down, m along
    mujoco.mj_step(model, data)
    if step % 10 == 9:
        touches.append(skin.feel(data))
    if step % 200 == 199:
        print(f"{data.time:.1f} s: {touches[-1].force_n:.0f} N press")
        for c in touches[-1].frame.contacts:
            print(f"  felt: {c.force_n or np.nan:.0f} N at {c.x_m * 1e3:.1f}, {c.y_m * 1e3:.1f} mm")
print(f"{len(touches) / (time.process_time() - began_s):.0f} frames a second of processor time")
figure = Figure(figsize=(11, 3.4), layout="constrained")
left, *maps = figure.subplots(1, 3)
with mujoco.Renderer(model, 560, 640) as renderer:
    renderer.update_scene(data)
    left.imshow(renderer.render())
left.axis("off")
images = {"truth": touches[-1].truth_kpa, "felt": touches[-1].frame.pressure_kpa}
for axes, (title, kpa) in zip(maps, images.items(), strict=True):
    image = axes.imshow(kpa, origin="lower", extent=[-75, 75] * 2, vmin=0, vmax=np.nanmax(kpa))
    axes.set_title(f"{title}: at most {np.nanmax(kpa):.0f} kPa")
    figure.colorbar(image, label="kPa")
figure.savefig("grasp.png", dpi=80)
