"""From volts to changes: polarity, plausibility, reference, changes."""
