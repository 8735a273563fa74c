"""The sheet's physics: mesh, Green's functions, forward model, artifacts, sensitivity."""
