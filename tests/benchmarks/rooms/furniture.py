"""Furniture of Debian's package `sweethome3d-furniture`, fetched when it is first needed; none is in the repository.

Its pieces are under CC0 or CC-BY; `credits.txt` beside the cache names author and licence of each.
"""

import io
import json
import re
import subprocess
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

PACKAGE = "sweethome3d-furniture"
TEXTURE_SIDE = 256
_SETS = {"BlendSwap-CC-0": "CC0", "BlendSwap-CC-BY": "CC-BY", "KatorLegaz": "CC-BY", "Scopia": "CC-BY"}
_CATEGORIES = {"Living room", "Kitchen", "Bedroom", "Bathroom", "Office", "Lights", "Miscellaneous"}
_UNWANTED = re.compile(
    r"gun|rifle|tank|sword|plug|switch|RJ-|fleche|passage|man\b|woman|person|car\b|truck|rocket|grenade|tree|cat$|dog$"
    r"|rabbit|horse|mannequin|water$",
    re.IGNORECASE,
)
_KINDS = {
    "lamp": r"lamp|light|lantern|candle|spotlight",
    "plant": r"plant|cactus|yucca|vase|pottery",
    "screen": r"^tv 16|flat tv|screen|imac|ibook|laptop|^tablet",
    "bed": r"\bbed\b|crib|mattress|futon$|tatami|sleeping bag",
    "seating": r"chair|sofa|couch|seat|stool|(?<!work)bench$|puff|living room",
    "floor": r"rug|carpet|mat$",
    "curtain": r"curtain|blind|towel|hanging clothes|dress$|suit$|jacket|trousers|skirt",
    "picture": r"white board|frame|calendar|dart game",
    "table": r"table(?! tennis bat)|desk|^island(?! bath)|workbench",
    "storage": r"bookcase|shelves|cabinet|cupboard|wardrobe|drawers|chest(?! freezer)|box$|locker|tv stand"
    r"|basket(?!ball)|crate|rack$|vanity|dresser|safe",
    "appliance": r"fridge|freezer|oven|cook(er|top)|stove|hood|machine|dryer|boiler|heater|radiator|sink|basin|bath"
    r"|shower|toilet|bidet|urinal|lavatory|fireplace|furnace|chimney|air conditioning|microwave|refrigerator",
}
"""What is in the names of the pieces of a class; the first that is there counts."""
_MOST_TRIANGLES = 24_000
_GREY = (0.7, 0.7, 0.7)


@dataclass(frozen=True)
class Piece:
    """A piece of furniture: size (3,) metres (width, height, depth), elevation of its foot; triangles (F, 3, 3) centred
    over its foot, their normals and texture places (F, 3, 2), material of each, and of each material its colour and the
    number of its texture (-1: none)."""

    name: str
    category: str
    size: tuple[float, float, float]
    elevation: float
    movable: bool
    triangles: NDArray[np.float32]
    normals: NDArray[np.float32]
    places: NDArray[np.float32]
    material: NDArray[np.int32]
    materials: list[tuple[tuple[float, float, float], int]]

    @property
    def kind(self) -> str:
        """Its class; "thing" for what is of none."""
        return next((k for k, words in _KINDS.items() if re.search(words, self.name, re.IGNORECASE)), "thing")


@dataclass(frozen=True)
class Catalogue:
    """All pieces, and their textures (T, side, side, 3) RGB."""

    pieces: list[Piece]
    textures: NDArray[np.uint8]


def load_furniture(folder: Path, package: Path | None = None) -> Catalogue:
    """The catalogue out of the cache in `folder`; made there from the package's .deb file, which is downloaded by
    `apt-get` where none is given. Raises RuntimeError where it cannot be had."""
    target = folder / "furniture.npz"
    if not target.exists():
        folder.mkdir(parents=True, exist_ok=True)
        _make_cache(_extracted(folder, package), target)
    return _read_cache(target)


def _extracted(folder: Path, package: Path | None) -> Path:
    place = folder / "package"
    inside = place / "usr" / "share" / "sweethome3d" / "furniture"
    if not inside.exists():
        if package is None:
            done = subprocess.run(["apt-get", "download", PACKAGE], cwd=folder, capture_output=True, text=True)
            found = sorted(folder.glob(f"{PACKAGE}_*.deb"))
            if not found:
                raise RuntimeError(f"{PACKAGE} cannot be downloaded ({done.stderr.strip()}): give it with --package")
            package = found[-1]
        subprocess.run(["dpkg-deb", "-x", str(package), str(place)], check=True)
    return inside


def _make_cache(inside: Path, target: Path) -> None:
    pieces: list[tuple[dict[str, Any], tuple[NDArray[Any], ...]]] = []
    textures: list[NDArray[np.uint8]] = []
    for name in _SETS:
        with zipfile.ZipFile(inside / f"{name}.sh3f") as archive:
            pieces += _pieces_of(archive, _SETS[name], textures)
    columns = [np.concatenate(parts) for parts in zip(*(arrays for _, arrays in pieces), strict=True)]
    described = [{**meta, "count": len(arrays[0])} for meta, arrays in pieces]
    names = ("triangles", "normals", "places", "material")
    about = np.frombuffer(json.dumps(described).encode(), np.uint8)
    np.savez_compressed(target, textures=np.stack(textures), about=about, **dict(zip(names, columns, strict=True)))
    lines = [f"{m['model']}\t{m['name']}\t{m['licence']}\t{m['by']}" for m in described]
    target.with_name("credits.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _read_cache(target: Path) -> Catalogue:
    with np.load(target, allow_pickle=False) as held:
        about = json.loads(held["about"].tobytes())
        columns = [held[name] for name in ("triangles", "normals", "places", "material")]
        textures = held["textures"]
    ends = np.cumsum([m["count"] for m in about])[:-1]
    parts = zip(*(np.split(c, ends) for c in columns), strict=True)
    pieces = [
        Piece(m["name"], m["category"], tuple(m["size"]), m["elevation"], m["movable"], *arrays,
              [(tuple(rgb), t) for rgb, t in m["materials"]])
        for m, arrays in zip(about, parts, strict=True)
    ]  # fmt: skip
    return Catalogue(pieces, textures)


def _pieces_of(
    archive: zipfile.ZipFile, licence: str, textures: list[NDArray[np.uint8]]
) -> Iterator[tuple[dict[str, Any], tuple[NDArray[Any], ...]]]:
    names, numbers = set(archive.namelist()), dict[str, int]()
    for item in _properties(archive):
        model = item.get("model", "").lstrip("/")
        wanted = item.get("category") in _CATEGORIES and item.get("doorOrWindow") != "true"
        if not wanted or model not in names or not model.endswith(".obj"):
            continue
        if _UNWANTED.search(item.get("name", "")) or _UNWANTED.search(item.get("id", "")):
            continue
        try:
            found = _Model(archive, model)
        except (ValueError, IndexError, KeyError):
            continue
        if not 0 < len(found.faces) <= _MOST_TRIANGLES:
            continue
        meta = {
            "model": model, "name": item["name"], "category": item["category"], "licence": licence,
            "by": item.get("creator", ""), "movable": item.get("movable") == "true",
            "elevation": float(item.get("elevation", 0)) / 100,
            "size": [float(item[k]) / 100 for k in ("width", "height", "depth")],
        }  # fmt: skip
        materials, shown = found.materials_of(archive, names, textures, numbers)
        if (arrays := found.placed(meta["size"], item.get("modelRotation"), shown)) is not None:
            yield {**meta, "materials": materials}, arrays


def _properties(archive: zipfile.ZipFile) -> list[dict[str, str]]:
    text = archive.read("PluginFurnitureCatalog.properties").decode("latin1")
    items: dict[int, dict[str, str]] = {}
    for key, number, value in re.findall(r"^(\w+)#(\d+)=(.*)$", text, re.MULTILINE):
        items.setdefault(int(number), {})[key] = value.strip().split("|")[0]
    return list(items.values())


class _Model:
    """A Wavefront OBJ file: vertices, faces split into triangles, names of the materials."""

    def __init__(self, archive: zipfile.ZipFile, path: str) -> None:
        self.base = path.rsplit("/", 1)[0]
        self.columns: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
        self.faces: list[list[list[int]]] = []
        self.of_face: list[int] = []
        self.numbers: dict[str, int] = {}
        self.library: dict[str, dict[str, Any]] = {}
        current = self.numbers.setdefault("", 0)
        with archive.open(path) as stream:
            for line in io.TextIOWrapper(stream, "latin1"):
                key, *rest = line.split() or [""]
                if key in self.columns:
                    self.columns[key].append([float(x) for x in rest[: 2 if key == "vt" else 3]])
                elif key == "usemtl":
                    current = self.numbers.setdefault(" ".join(rest), len(self.numbers))
                elif key == "mtllib":
                    self._read_library(archive, f"{self.base}/{' '.join(rest)}")
                elif key == "f":
                    corners = [[int(x or 0) for x in (c + "//").split("/")[:3]] for c in rest]
                    self.faces += [[corners[0], corners[i], corners[i + 1]] for i in range(1, len(corners) - 1)]
                    self.of_face += [current] * (len(corners) - 2)

    def _read_library(self, archive: zipfile.ZipFile, path: str) -> None:
        if path not in archive.namelist():
            return
        current: dict[str, Any] = {}
        for line in archive.read(path).decode("latin1").splitlines():
            key, *rest = line.split() or [""]
            if key == "newmtl":
                current = self.library.setdefault(" ".join(rest), {})
            elif key == "Kd":
                current["rgb"] = tuple(float(x) for x in rest[:3])
            elif key == "d":
                current["opacity"] = float(rest[-1])
            elif key == "map_Kd":
                current["texture"] = f"{self.base}/{rest[-1]}"

    def materials_of(
        self, archive: zipfile.ZipFile, names: set[str], textures: list[NDArray[np.uint8]], numbers: dict[str, int]
    ) -> tuple[list[tuple[tuple[float, ...], int]], NDArray[np.bool_]]:
        """Colour and texture of each material, and which are opaque enough to be seen."""
        out, shown = [], []
        for name in self.numbers:
            about = self.library.get(name, {})
            path = about.get("texture")
            if path in names and path not in numbers:
                image = cv2.imdecode(np.frombuffer(archive.read(path), np.uint8), cv2.IMREAD_COLOR)
                if image is not None:
                    numbers[path] = len(textures)
                    small = cv2.resize(image, (TEXTURE_SIDE, TEXTURE_SIDE), interpolation=cv2.INTER_AREA)
                    textures.append(np.ascontiguousarray(small[..., ::-1]).astype(np.uint8))
            out.append((about.get("rgb", _GREY), numbers.get(path, -1)))
            shown.append(about.get("opacity", 1.0) > 0.45)
        return out, np.array(shown)

    def placed(
        self, size: list[float], rotation: str | None, shown: NDArray[np.bool_]
    ) -> tuple[NDArray[Any], ...] | None:
        """Triangles, normals, texture places and materials in metres, centred over the foot; None if hardly any."""
        faces, material = np.array(self.faces), np.array(self.of_face, np.int32)
        points, places, normals = (self._corners(k, faces[..., i]) for i, k in enumerate(("v", "vt", "vn")))
        if rotation:
            turn = np.array(rotation.split(), float).reshape(3, 3)
            points, normals = points @ turn.T, normals @ turn.T
        low, high = points.min((0, 1)), points.max((0, 1))
        scale = np.array(size) / np.maximum(high - low, 1e-9)
        points = (points - [(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2]) * scale
        flat = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        area = np.linalg.norm(flat, axis=1)
        normals = normals / np.maximum(scale, 1e-9)
        length = np.linalg.norm(normals, axis=2, keepdims=True)
        flat = (flat / np.maximum(area, 1e-12)[:, None])[:, None]
        normals = np.where(length > 1e-9, normals / np.maximum(length, 1e-9), flat)
        good = shown[material] & (area > 1e-10)
        if good.sum() < 4:
            return None
        places = np.stack([places[..., 0], 1 - places[..., 1]], axis=-1)
        return (*(a[good].astype(np.float32) for a in (points, normals, places)), material[good])

    def _corners(self, key: str, index: NDArray[np.int64]) -> NDArray[np.float64]:
        held = np.array(self.columns[key], float).reshape(-1, 2 if key == "vt" else 3)
        if len(held) == 0:
            return np.zeros((*index.shape, 2 if key == "vt" else 3))
        return held[np.clip(np.where(index < 0, index + len(held), index - 1), 0, len(held) - 1)]


@cache
def furniture(folder: str, package: str = "") -> Catalogue:
    """`load_furniture`, read once a process."""
    return load_furniture(Path(folder), Path(package) if package else None)
