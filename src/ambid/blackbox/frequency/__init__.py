"""Parametric models from frequency responses: rational, state space, and the physical parameters themselves."""
