"""Process-level services for every folder: compiled loops and what they run on, identity of the code, memory, signals,
progress.

Nothing here knows of maps, images or stages' results. `progress.py` has progress and soft stops, `parallel.py` threads
and caches, `values.py` any value of this program as a file. `jit.py` compiles kernels, in which `lanes.py` has vectors;
`threads.py` is the pool that runs them, `gpu.py` starts those of Triton; `adam.py`, `ssim.py` and `raster.py` are ready
ones.
"""
