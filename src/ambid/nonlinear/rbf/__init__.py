"""Networks of radial basis functions on lagged outputs and inputs (structure `rbf`)."""
