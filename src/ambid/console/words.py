"""What the page calls the settings and jobs that messages name: its fields and buttons, or the place in the rig."""

from collections.abc import Mapping

PAGE_WORDS: Mapping[str, str] = {
    "rate_hz": "Rate", "gaps": "Gaps", "out": "the name", "rig": "Rig", "port": "Port", "seconds": "Length",
    "excitation": "Excitation", "amplitude": "Amplitude", "estimate": "Start", "arm": "Loop to try",
    "redesign": "redesign the loop",
    "layout": "layout in [record] of the rig", "from_s": "from in [record] of the rig",
    "to_s": "to in [record] of the rig", "reference": "[channels.reference] of the rig",
    "delay": "delay of the channel in the rig", "bench": "daq.bench of the rig", "identify": "Identify",
    "margins": "Margins", "design_controller": "Design a better loop", "commission": "Commission",
    "acquire": "Record and track", "track": "Record and track",
}  # fmt: skip
"""By their names in Python; any other is called as the command calls it, and said to be the command's."""

RIG_WORDS = {**PAGE_WORDS, "rate_hz": "rate_hz in [record] of the rig", "gaps": "gaps in [record] of the rig"}
"""Where a record is read through a rig."""
