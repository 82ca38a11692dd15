"""Estimate of the world's unit in metres and its uncertainty: one file for each source of evidence, one for all."""
