"""Stage 6: the results as files that other programs open.

In go the results of the stages before (`pipelines/outcome.py`); out come the files of export/: the map as splats, the
poses as COLMAP, nerfstudio and TUM have them, the labelled mesh, and README.txt, which says what each file is for.
Begin with `run` in `stage.py`; `writers.py` writes all but the mesh, which `mesh.py` draws, fuses (`volume.py`) and
extracts (`surface.py`), and `extra/` holds the writers of files that are made only where somebody asks for them.
"""
