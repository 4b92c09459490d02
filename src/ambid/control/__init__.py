"""The loop as it is: its controller, sensitivity, margins and compliance."""
