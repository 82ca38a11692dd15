"""A class for every pixel of the keyframes: from the scene's shape, from a network, or from files.

In go the keyframes with their cameras and depths, out come labels and confidence for each (`LabelEstimate`), and one
table of classes. Begin with `shape.py`, the network that comes with the program, then `named.py`, which brings what it
or a downloaded network (`learned.py`) says of all frames to whole parts of the scene.
"""
