"""Sensor descriptions from files of other programs: drawings, and models of EIDORS and pyEIT."""
