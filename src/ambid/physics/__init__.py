"""Parameters, magnets, plant models and their discretisation, control loop and presets: no data in this room."""
