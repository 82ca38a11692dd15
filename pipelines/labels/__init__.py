"""A class for every pixel of the keyframes: from the scene's own layout, from a network, or from files.

In go the keyframes with their cameras and depths, out come labels and confidence for each (`LabelEstimate`), and one
table of classes. Begin with `segments.py`, which needs no weights, then `learned.py`, whose names `named.py` brings to
whole parts of the scene.
"""
