"""Sources of images: videos, folders, panoramas, data sets.

In goes what the user names, out come frames one after the other, with times, names and whatever is known of the camera.
Begin with `open_recording` in `recording.py`; `given.py` reads poses and calibration that the user gives;
`extending.py` adds videos to a finished run.
"""
