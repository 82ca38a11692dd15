"""What `frames` tells of GPS, long before the export uses it."""

from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from msgs_slam.pipelines.frames.stage import places_figure
from msgs_slam.pipelines.source.opening import open_source
from msgs_slam.pipelines.types import Frame


def write_photos(folder: Path, placed: int, count: int) -> Path:
    """Pictures of which the first `placed` say where they were taken."""
    folder.mkdir()
    for i in range(count):
        image = Image.fromarray(np.full((48, 64, 3), 30 * i, np.uint8))
        exif = Image.Exif()
        if i < placed:
            exif[ExifTags.Base.GPSInfo] = {1: "N", 2: (55.0, 41.0, 0.1 * i), 3: "E", 4: (13.0, 11.0, 0.0)}
        image.save(folder / f"{i}.jpg", exif=exif)
    return folder


def test_how_many_pictures_say_where_they_were_taken(tmp_path: Path) -> None:
    frames = [Frame(i, f"{i}.jpg", float(i), i, 1.0) for i in range(4)]
    some, none = (open_source(write_photos(tmp_path / str(n), n, 4), "auto") for n in (3, 0))
    assert places_figure(some, frames) == {"gps": "of 3 of 4 images"}
    assert places_figure(none, frames) == {}
