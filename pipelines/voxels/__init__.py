"""Voxels of the reconstructed room, and its floor, walls and ceiling."""
