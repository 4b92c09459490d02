"""Recursive instrumental variables: consistent where noise reaches the regressor, as in a loop."""
