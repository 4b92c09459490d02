"""Nonlinear black-box models: what they share; each family is a package or file of its own beside this one."""
