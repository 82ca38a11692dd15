"""Depth and labels from files of the user or of a data set."""
