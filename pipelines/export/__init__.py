"""Stage 6: the results as files that other programs open.

In go the results of the stages before (`run/outcome.py`); out come the files of export/: the map as splats, the poses
as COLMAP, nerfstudio and TUM have them, the labelled mesh, and README.txt, which says what each file is for.
`kinds.py` lists them, a row a kind, with the function that writes it from an `ExportScene` (`scene.py`); begin with
`stage.py`. The mesh is drawn in `mesh.py`, fused (`volume.py`), extracted (`surface.py`) and painted (`texture.py`).
"""
