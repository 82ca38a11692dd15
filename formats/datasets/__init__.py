"""Readers of the data sets that the field uses, all giving the same `Sequence`."""

from msgs_slam.formats.datasets.camera import Camera
from msgs_slam.formats.datasets.opening import FORMATS, looks_like_recording, open_sequence, recognise, recognise_source
from msgs_slam.formats.datasets.sequence import VOID_LABEL, LabelClass, Sequence

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
