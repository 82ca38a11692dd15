"""The scene as a whole, told by the finished map: its upright, its place on Earth, and how long a metre is.

In go the poses, the depth maps and their labels, out come `World` (the axes of the exported files) and `Metres`.
Begin with `world.py` and `metres.py`.
"""
