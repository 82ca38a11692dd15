"""Stage 1: from a source to frames, a calibrated camera and a backbone of keyframes.

In goes a source (`source/`), out come undistorted frames with timestamps and what `sfm/` finds of the keyframes. Begin
with `run` in `stage.py`: `keyframes.py` picks frames and chooses keyframes, `masks.py` leaves out what is no scene,
`tasks.py` starts structure from motion, `findings.py` holds what is said of the result.
"""
