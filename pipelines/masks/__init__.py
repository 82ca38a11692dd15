"""Masks of what in an image is not part of the scene: the user's, and people. True = left out."""
