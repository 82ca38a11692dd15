"""Geometry that several rooms share: motions, cameras, sparse models, posed depth, voxels.

In go and out come plain arrays and the types of `pipelines/types.py`. Begin with `se3.py` (motions, similarities) and
`camera.py` (projection, rigs); `voxels.py` sums what frames see of a place, and finds its up and floor.
"""
