"""
A bench identified
==================

From a record to physical parameters with their uncertainty, in Python alone.
"""

import ambid

record = ambid.simulate("levitated-ball", duration=10.0, band=(0.2, 200.0), seed=1)
estimate = ambid.identify(record)
print(estimate.verdict.word)
