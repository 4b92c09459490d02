"""Filters that run beside the plant: one sample or one block at a time, with the same numbers."""
