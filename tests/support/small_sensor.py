"""A small sheet that solves in a blink, for what does not depend on the paper's sensor."""

SMALL = """
schema = 1
name = "small"
[sheet]
shape = "rectangle"
width_m = 0.06
height_m = 0.05
conductivity_s_m = 1.0
thickness_m = 1e-4
[electrodes]
per_side = 2
length_m = 0.006
pitch_m = 0.02
contact_impedance_ohm_m = 10.0
[pattern]
current_a = 1e-4
[map]
nodes_x = 21
nodes_y = 21
[magnitude.response]
pressure_kpa = [0.0, 100.0, 200.0]
relative_change = [0.0, 0.0, 0.25]
[structure]
conductivity_ratio = 100.0
"""
