"""Stage 3: a pose for every picked frame.

In go the backbone of structure from motion and the proxy's depths, out come the trajectory, its segments and the sparse
model. Begin with `run` in `stage.py`: `front_end.py` poses the frames between keyframes, `adjust.py` adjusts them all,
`links.py` finds what joins segments and closes loops, `graph.py` spreads what is left of the drift.
"""
