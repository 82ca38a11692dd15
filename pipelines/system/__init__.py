"""Process-level services for every folder: compiled kernels, identity of the code, memory, signals, progress."""
