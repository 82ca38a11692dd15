"""Running of stages and their tasks: one after the other here, by other processes, by a Ray cluster."""
