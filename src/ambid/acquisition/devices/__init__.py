"""The four devices: serial hardware, the emulated controller, a simulated bench, a replayed record."""
