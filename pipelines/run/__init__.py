"""A run's folder as a database: its files, manifest, settings and lock.

Every file has a row in `files.py`, from which `RunFolder` (`folder.py`) loads it as the type that the row names. Begin
there; `ending.py` finishes a stage in steps that a kill cannot spoil, `lock.py` lets one process work at a time.
"""
