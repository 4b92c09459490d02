"""From acquisition to tracking: blocks, a ring in shared memory, a guard against damage, replay."""
