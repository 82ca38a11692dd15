"""Writers of files that are made only where somebody asks for them.

In goes an outcome with the world of its files, or the mesh of the run; out come a texture, 3D Tiles, USD, a mesh to
walk in, a floor plan or a web page, each by one function that returns the paths it wrote. None knows another, nor the
rest of the export: begin with `_writers` in `../stage.py`, where each has a row.
"""
