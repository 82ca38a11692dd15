"""Unsupervised regions of the whole video: voxels of all frames, named by geometry where that is sure."""
