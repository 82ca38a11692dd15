"""Stage 5: poses of the images between the picked frames.

In go the trajectory, the sparse model and the finished map, out come all of them as they are, with a pose for every
image of a video. Begin with `run` in `stage.py`: `between.py` poses what lies between.
"""
