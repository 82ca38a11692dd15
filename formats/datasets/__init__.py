"""Readers of the data sets that the field uses, all giving the same `Sequence`."""

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
