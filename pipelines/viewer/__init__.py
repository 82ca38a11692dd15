"""The interactive view in the browser, and films drawn from it.

In go a run, finished or not, or a splat file; out come a page (`server.py`) and images or a video (`render_run.py`).
Begin with `open_viewer` in `server.py`; `scene.py` is what it shows.
"""
