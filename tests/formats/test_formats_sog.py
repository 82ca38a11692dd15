"""SOG files, unpacked by the words of the specification."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from msgs_slam.formats.sog import write_sog
from tests.clouds import random_cloud

SH_C0 = 0.28209479177387814


def _unpacked(path: Path) -> tuple[dict, dict[str, NDArray[np.float64]]]:
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))

        def picture(name: str) -> NDArray[np.float64]:
            image = Image.open(io.BytesIO(archive.read(name)))
            assert (image.format, image.mode) == ("WEBP", "RGBA") or image.mode == "RGB"
            return np.asarray(image.convert("RGBA"), np.float64).reshape(-1, 4)[: meta["count"]]

        low, high = (picture(n)[:, :3] for n in meta["means"]["files"])
        mins, maxs = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
        logs = mins + (high * 256 + low) / 65535 * (maxs - mins)
        color, quats = picture(meta["sh0"]["files"][0]), picture(meta["quats"]["files"][0])
        scales = np.array(meta["scales"]["codebook"])[picture(meta["scales"]["files"][0])[:, :3].astype(int)]
        base = np.array(meta["sh0"]["codebook"])[color[:, :3].astype(int)]
    parts = (quats[:, :3] / 255 - 0.5) * np.sqrt(2)
    largest = np.sqrt(np.maximum(1 - (parts**2).sum(1), 0))
    wxyz = np.array(
        [np.insert(p, int(kind) - 252, whole) for p, kind, whole in zip(parts, quats[:, 3], largest, strict=True)]
    )
    return meta, {
        "means": np.sign(logs) * np.expm1(np.abs(logs)), "log_scales": scales, "colors": 0.5 + SH_C0 * base,
        "opacity": color[:, 3] / 255, "quat_wxyz": wxyz,
    }  # fmt: skip


@pytest.mark.parametrize("count", [1, 17, 3000])
def test_a_cloud_is_what_was_written(tmp_path: Path, count: int) -> None:
    cloud = random_cloud(count)
    write_sog(tmp_path / "a.sog", cloud)
    meta, found = _unpacked(tmp_path / "a.sog")
    assert (meta["version"], meta["count"]) == (2, count)
    row = np.linalg.norm(found["means"][:, None] - cloud.means[None], axis=2).argmin(axis=1)
    assert sorted(row.tolist()) == list(range(count))
    np.testing.assert_allclose(found["means"], cloud.means[row], atol=2e-3)
    np.testing.assert_allclose(found["log_scales"], cloud.log_scales[row], atol=0.25)
    assert np.abs(found["log_scales"] - cloud.log_scales[row]).mean() < 0.01
    assert np.abs(found["colors"] - cloud.colors[row]).max() < 1 / 255
    np.testing.assert_allclose(found["opacity"], 1 / (1 + np.exp(-cloud.opacity_logits[row])), atol=0.003)
    assert (np.abs((found["quat_wxyz"] * cloud.quat_wxyz[row]).sum(1)) > 0.9999).all()


def test_the_same_cloud_gives_the_same_bytes_and_none_is_refused(tmp_path: Path) -> None:
    for name in ("a.sog", "b.sog"):
        write_sog(tmp_path / name, random_cloud(100))
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()
    with pytest.raises(ValueError, match="without Gaussians"):
        write_sog(tmp_path / "c.sog", random_cloud(0))
