"""Readers of the data sets that the field uses.

A folder or file goes in; a `Sequence` comes out: names, times and images, with whatever camera, poses, depth and labels
the set has, in one set of conventions. Begin with `open_sequence` and with `sequence.Sequence`.
"""

from .opening import FORMATS, looks_like_recording, open_sequence, recognise, recognise_source
from .sequence import VOID_LABEL, Camera, LabelClass, Sequence

__all__ = [
    "FORMATS",
    "VOID_LABEL",
    "Camera",
    "LabelClass",
    "Sequence",
    "looks_like_recording",
    "open_sequence",
    "recognise",
    "recognise_source",
]
