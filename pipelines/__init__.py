"""Everything that computes. Imports `formats`, never `msgs_cli`."""
