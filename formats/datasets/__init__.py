"""Readers of the data sets that the field uses.

A folder or file goes in; a `Dataset` comes out: names, times and images, with whatever camera, poses, depth and labels
the set has, in one set of conventions. Begin with `open_sequence` and with `sequence.Sequence`.
"""

from .opening import FORMATS, is_recording_folder, open_sequence, recognise, recognise_source
from .sequence import VOID_LABEL, Camera, Dataset, LabelClass

__all__ = [
    "FORMATS",
    "VOID_LABEL",
    "Camera",
    "Dataset",
    "LabelClass",
    "is_recording_folder",
    "open_sequence",
    "recognise",
    "recognise_source",
]
