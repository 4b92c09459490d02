"""The line to a controller: the port, the thread that reads it, commands with acknowledgement, the clocks' drift."""
