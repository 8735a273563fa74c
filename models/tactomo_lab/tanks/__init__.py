"""Round tanks: what stands in the saline, of either kind, from any readings of any electrodes."""
