"""Process-level services for every folder: compiled kernels, identity of the code, memory, signals, progress.

Nothing here knows of images or stages' results. Begin with `progress.py` (progress and soft stops) and `parallel.py`
(threads and caches); `values.py` keeps any value of this program as a file.
"""
