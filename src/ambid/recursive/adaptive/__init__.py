"""Recursive estimators of linear regressions y = φᵀθ + e: gradient, least squares, instrumental variables."""
