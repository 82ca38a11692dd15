"""Stage 2, proxy: depth, its reliability and a class for every pixel of the keyframes, before there is a map.

In go the keyframes and what structure from motion knows of them, out comes one file of maps for each. `stage.py` is
the order of the work, `tasks.py` the work over ranges of keyframes, `selection.py` the choice of providers by the
settings.
"""
