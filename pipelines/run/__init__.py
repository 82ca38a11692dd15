"""A run: its folder as a database (files, manifest, settings, lock), and the stages that are brought up to date in it.

Every file has a row in `files.py`; `RunFolder` (`folder.py`) loads it, and the stage's context (`stages.py`) leaves it,
as the type that the row names; `outcome.py` puts together what all stages have found. `runner.py` runs what is not up
to date, by what each stage has read (`reads.py`); `ending.py` finishes one in steps that a kill cannot spoil;
`cluster.py` takes its tasks to other processes and machines.
"""
