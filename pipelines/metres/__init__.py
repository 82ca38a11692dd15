"""How long the world's unit is in metres, and how sure that is: one file for each source of evidence, one for all."""
