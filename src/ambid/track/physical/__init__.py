"""Recursive prediction error estimation of physical parameters, on the innovations form of the off-line estimator."""
