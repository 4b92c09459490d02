"""What watches the tracking: error level, change detection, excitation, validation gate, flags, and the log."""
