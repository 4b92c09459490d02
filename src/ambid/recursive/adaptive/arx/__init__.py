"""Regressors from signals as they come, and ARX models estimated on them."""
