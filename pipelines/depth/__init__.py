"""Depth of the keyframes: by stereo, from a network, from files, or from stereo and a network together.

In go the keyframes with their cameras (`providers.Sequence`), out come depth and confidence for each (`DepthEstimate`);
`fields`, `scales` and `align` bring depth of another unit to the scale of the poses, once for each keyframe.
Begin with `stereo/provider.py`, the default, then `fused.py`.
"""
