"""Metrics, the evaluation of a run against the truth, and the report."""
