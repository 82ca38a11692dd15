"""Bytes to plain arrays and back: video, images, COLMAP, PLY, meshes, trajectories. Imports neither other package."""
