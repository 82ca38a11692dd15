"""Running of stages and their tasks: one after the other here, or on the nodes of a Ray cluster.

In goes a list of stages (`reconstruct.py`), out come their folders and records. Begin with `run_stages` in `runner.py`;
`tasks.py` divides a stage's work, `cluster.py` has it done by Ray.
"""
