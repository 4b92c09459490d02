"""The nonlinear bearing, grey box: one co-energy, coil, mass; extended Kalman predictor, maximum likelihood."""
