"""
A bench identified, from a DataFrame
====================================

From columns of numbers to physical parameters with their uncertainty, judged on a second record, in Python alone.
"""

# %%
# Columns of numbers
# ------------------
#
# The record of this page is simulated, so that it runs anywhere: a steel ball of 60 g floats under one magnet, a
# controller holds it, and a multisine is added to the voltage. Yours comes from ``pandas.read_csv``, a database, a
# logger. What counts is that each column says its unit: ``name [unit]``.

import ambid

simulated = ambid.simulate("levitated-ball", duration=10.0, band=(0.2, 200.0), seed=1)
table = simulated.to_dataframe()
table.head()

# %%
# A `Record` keeps the columns as SI channels of one sampling rate. Whatever does not fit (an unknown unit, a missing
# value, a time that jumps) is refused with one line that says where.

record = ambid.Record.from_dataframe(table)
print(record.n_samples, "samples at", record.rate_hz, "Hz")
record[2.0:2.5].plot()

# %%
# What is known of the bench
# --------------------------
#
# Without any knowledge, five parameters come from this record. The ball was weighed, however, and a mass that is known
# makes the others far more accurate. What is known stands in a rig file, or in a text of that
# form; ``ambid init`` drafts one from a record.

from ambid.rig import rig_from_text

known = """
schema = "ambid.rig/1"
model  = "one-axis"
[parameters]
m = { value = 60.0, unit = "g", role = "fixed" }
"""
bench = rig_from_text(known, "bench.toml")
estimate = ambid.identify(record, bench)
estimate

# %%
# The verdict comes first
# -----------------------
#
# *usable*, *use with caution* or *do not use*, with reasons. A number under *do not use* is no result.

print(estimate.verdict.word, estimate.verdict.reasons)

# %%
# One parameter: its value, standard deviation and 95 % interval, in SI units.

k_i = estimate["k_i"]
low, high = k_i.ci95
print(f"{k_i.value:.4f} ± {k_i.sd:.4f} {k_i.unit}, 95 % interval {low:.4f} to {high:.4f}")

# %%
# All of them as a table for further work:

estimate.to_dataframe()

# %%
# Look at it
# ----------
#
# Signals and residuals, the response of plant and model, the poles.

estimate.plot()

# %%
# Judge it on data that it has not seen
# -------------------------------------
#
# Other excitation, same bench. Parameters stay as they are.

second = ambid.simulate("levitated-ball", duration=5.0, band=(0.2, 200.0), seed=2)
judged = estimate.validate(second)
print(judged.verdict.word)

# %%
# Keep it
# -------
#
# ``estimate.report("bench.html")`` writes a page for colleagues, ``estimate.save`` a file that ``ambid.load`` and the
# commands read; ``estimate.to_control()`` gives a state space for python-control.

from pathlib import Path
from tempfile import TemporaryDirectory

with TemporaryDirectory() as folder:
    path = Path(folder) / "bench.json"
    estimate.save(path)
    print(ambid.load(path)["k_i"].value == k_i.value)
