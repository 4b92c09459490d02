"""Acquisition: from a controller, real, emulated or simulated, to a record and to whoever listens meanwhile."""
