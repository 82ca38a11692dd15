"""Stage 6: the results as files that other programs open."""
