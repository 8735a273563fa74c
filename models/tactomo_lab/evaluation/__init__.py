"""How right the reconstruction is: methods on scenes with known truth, and what comes of that."""
