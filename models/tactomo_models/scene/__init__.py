"""What presses: presses, shapes, areas, contacts, pressure."""
