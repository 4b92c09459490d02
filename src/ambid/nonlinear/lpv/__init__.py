"""Linear models whose coefficients follow a scheduling signal: LPV difference equations with an error model.

`estimate` is the method, `shape` its equations, `schedule` where the scheduling signal comes from, `frozen` what the
model is at one set point.
"""
