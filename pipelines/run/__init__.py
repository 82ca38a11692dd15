"""A run: its folder as a database (files, manifest, settings, lock), and the stages that are brought up to date in it.

Every file has a row in `files.py`, from which `RunFolder` (`folder.py`) loads it as the type that the row names.
`runner.py` runs what is not up to date, by what each stage (`stages.py`) has read (`reads.py`); `ending.py` finishes
one in steps that a kill cannot spoil; `tasks.py` parts its work, `cluster.py` takes the parts to other machines.
"""
