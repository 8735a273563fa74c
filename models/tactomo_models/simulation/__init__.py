"""Simulated skins: their voltages under presses, and their drift."""
