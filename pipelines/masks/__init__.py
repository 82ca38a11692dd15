"""Masks of what in an image is not part of the scene; True = left out.

In go images with people (`people.py`), a recording of which a part stands still (`still.py`), or keyframes with depth
in which something moved (`moving.py`); out come masks (H, W) that features, depth and the map ignore. The user's own
mask files are read in `frames/`.
"""
