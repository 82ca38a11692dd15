"""Which way is up, and the world that the exported files stand in."""
