"""The reconstruction methods, and the parts that they share."""
