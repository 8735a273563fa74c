"""`tactomo doctor`: whether a skin and its device are well."""
