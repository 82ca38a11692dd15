"""What every folder needs of the process: compiled kernels, identity of the code, memory, signals, progress."""
