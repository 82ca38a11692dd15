"""Running of stages and their tasks: one after the other here, by other processes, by a Ray cluster.

In goes a list of stages (`reconstruct.py`), out come their folders and records. Begin with `run_stages` in `runner.py`;
`tasks.py` hands out a stage's tasks as files, `placement.py` starts processes that take them.
"""
