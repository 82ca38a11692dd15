"""A data set as a source: images, times and camera as its reader gives them."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from msgs_slam.formats.datasets import Camera, Sequence, open_sequence, recognise_source
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import exif_focal_px, image_size
from msgs_slam.formats.video import VideoFrame
from msgs_slam.pipelines.source.originals import reusable, written_names

Warn = Callable[[str], None]


def open_recording(path: Path, format: str) -> Sequence | None:
    """The data set that a source is; None for a video and for plain images.

    format: `auto` looks for what the path is; `images` takes it for a video or plain images in any case. Raises
    InputError where the path is no such data set.
    """
    found = recognise_source(path) if format == "auto" else format
    return None if found is None or found == "images" else open_sequence(path, found)


@dataclass
class RecordingSource:
    """The frames of a data set; a `Source`. Where the recording has depth or labels is no matter here."""

    sequence: Sequence
    path: Path = field(init=False)
    width: int = field(init=False)
    height: int = field(init=False)
    expected_frames: int = field(init=False)
    has_times: bool = field(init=False)
    _names: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        s = self.sequence
        self.path, self.expected_frames, self.has_times = s.root, len(s), s.timed
        self._names = written_names(s.names, s.root)
        if s.image_paths:
            self.width, self.height = image_size(s.image_paths[0])
        else:
            self.height, self.width = s.rgb(0).shape[:2]

    def read(self, wanted: Container[int] | None = None, warn: Warn | None = None) -> Iterator[VideoFrame]:
        """See `Source.read`; what the reader notes of the data set, and images that cannot be read, are reported."""
        if warn is not None:
            for note in self.sequence.notes:
                warn(f"{self.sequence.format}: {note}")
        for index in range(len(self.sequence)):
            if wanted is not None and index not in wanted:
                continue
            try:
                rgb = self.sequence.rgb(index)
            except InputError as error:
                if warn is not None:
                    warn(f"left out: {error}")
                continue
            if rgb.shape[:2] != (self.height, self.width):
                raise InputError(
                    f"{self.sequence.names[index]} of {self.path} is {rgb.shape[1]}x{rgb.shape[0]}, the first image is "
                    f"{self.width}x{self.height}: a recording has images of one size; resize or remove it"
                )
            yield VideoFrame(index, float(self.sequence.timestamps[index]), rgb)

    def name(self, frame_id: int, index: int) -> str:
        """The image's own name; formats that are not written here become .png."""
        return self._names[index]

    def original(self, index: int) -> Path | None:
        """The image's file, unless other programs would see it turned, transparent or not at all."""
        path = self.sequence.image_paths[index] if self.sequence.image_paths else None
        return path if path is not None and reusable(path) else None

    def exif_focal(self) -> float | None:
        """Return the focal length in pixels that the first image states, if any."""
        paths = self.sequence.image_paths
        return exif_focal_px(paths[0], self.width, self.height) if paths else None

    def known_camera(self) -> Camera | None:
        """The data set's camera at the size of its images."""
        camera = self.sequence.camera
        return None if camera is None else camera.resized(self.width, self.height)
