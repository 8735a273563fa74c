"""What a skin is: pattern, sheet, response, description and its file, symmetry."""
