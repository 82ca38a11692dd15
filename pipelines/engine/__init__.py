"""How stages and their tasks are run: one after the other here, by other processes, by a Ray cluster."""
