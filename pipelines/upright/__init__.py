"""The gravity direction, and the world of the exported files."""
