"""Stage 5: loops that tracking has left open are closed, and poses and map are adjusted together.

In go the trajectory and the finished map, out come both without the drift, and poses of the images between the picked
frames. Begin with `GlobalStage.run` in `stage.py`: `loops.py` proposes places seen again and measures them, `close.py`
distributes the drift, `between.py` poses what lies between.
"""
