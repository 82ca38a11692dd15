"""Dense depth from several posed views: plane sweep, semi-global smoothing, refinement, agreement between views.

In go the keyframes with the sparse model of structure from motion, out come depth and confidence of each. Begin with
`provider.py`; `matching.py` is the order of one match, `cuda.py` the same by kernels on a GPU.
"""
