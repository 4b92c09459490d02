"""On-line identification: recursive estimators, filters, supervised tracking of a bench's physical parameters."""
