"""How a skin and its electrodes are, from scans at rest."""
