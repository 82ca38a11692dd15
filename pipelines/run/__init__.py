"""A run's folder as a database: its files, manifest, settings and lock."""
