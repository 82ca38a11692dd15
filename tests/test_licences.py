"""Licences of what a plain install brings, and what the documentation says of licences, weights and packages."""

import importlib.metadata
import re
import tomllib

from packaging.requirements import Requirement

from tests.test_architecture import ROOT

PERMISSIVE = re.compile(r"apache|bsd|mit|mpl|psf|python software|zlib|cc0|hpnd|isc|bsl", re.IGNORECASE)
COPYLEFT = {
    "pi-heif": "LGPL-3.0",  # decodes HEIC; its libraries are linked dynamically
}
"""Packages under the GPL or LGPL by their own statement, which the documentation names."""
MENTIONS = {
    "backports-strenum": "the text of Python's licence says that it is compatible with the GPL",
    "llvmlite": "LLVM's licence says that it is compatible with the GPL",
    "ml-dtypes": "the MPL-2.0, Eigen's licence, names it as a secondary one",
    "numba": "the text of Python's licence says that it is compatible with the GPL",
    "numpy": "libgfortran and libquadmath, with the GCC runtime exception and under the LGPL, linked dynamically",
    "onnxruntime": "the MPL-2.0, Eigen's licence, names it as a secondary one",
    "opencv-python-headless": "FFmpeg under the LGPL, linked dynamically",
    "pillow": "FreeType is under a choice of two licences, of which one is not the GPL",
    "scipy": "libgfortran and libquadmath, as in numpy",
    "setuptools": "carries autocommand under the LGPL, for its own use",
    "torch": "LLVM's licence names it; a test of a part of kineto, which is not in the package, is under it",
    "typing-extensions": "the text of Python's licence says that it is compatible with the GPL",
}
"""Packages with a permissive licence whose files of licences mention the GPL, and why they may."""
NVIDIA = re.compile(r"nvidia-|cuda-")
"""What the PyTorch of PyPI brings for its cards, under NVIDIA's licence."""

WEIGHTS = {".npz", ".onnx", ".tflite", ".pt", ".pth", ".safetensors", ".bin", ".ckpt"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def plain_install() -> dict[str, importlib.metadata.Distribution]:
    """All packages that the requirements of the program lead to, without extras, as far as they are installed here."""
    found: dict[str, importlib.metadata.Distribution] = {}
    waiting = [Requirement(text) for text in PROJECT["dependencies"]]
    while waiting:
        wanted = waiting.pop()
        name = re.sub(r"[-_.]+", "-", wanted.name).lower()
        if name in found:
            continue
        try:
            found[name] = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        extras = wanted.extras or {""}
        inner = [Requirement(text) for text in found[name].requires or ()]
        waiting += [r for r in inner if r.marker is None or any(r.marker.evaluate({"extra": e}) for e in extras)]
    return found


def stated_licence(package: importlib.metadata.Distribution) -> str:
    meta = package.metadata
    classifiers = [c for c in meta.get_all("Classifier") or () if c.startswith("License ::")]
    return meta.get("License-Expression") or " ".join(classifiers) or (meta.get("License") or "")[:100]


def mentions_gpl(package: importlib.metadata.Distribution) -> bool:
    for file in package.files or ():
        if re.search(r"licen[cs]e|copying|notice", file.name, re.IGNORECASE) and file.suffix != ".py":
            text = package.locate_file(file).read_text(encoding="utf-8", errors="replace")  # type: ignore[attr-defined]
            if re.search(r"\bL?GPL|General Public License", text, re.IGNORECASE):
                return True
    return False


def test_a_plain_install_brings_permissive_licences() -> None:
    packages = {name: p for name, p in plain_install().items() if not NVIDIA.match(name)}
    assert {"torch", "numpy", "pi-heif"} <= packages.keys()
    stated = {name: stated_licence(p) for name, p in packages.items()}
    copyleft = {name for name, text in stated.items() if re.search(r"GPL|General Public", text, re.IGNORECASE)}
    assert copyleft == COPYLEFT.keys()
    assert {n: text for n, text in stated.items() if n not in copyleft and not PERMISSIVE.search(text)} == {}
    assert {n for n, p in packages.items() if mentions_gpl(p)} - copyleft <= MENTIONS.keys()


def test_the_documentation_names_the_weights_and_the_gpl_that_come_along() -> None:
    places = ("formats", "pipelines", "msgs_cli")
    weights = sorted(p for room in places for p in (ROOT / room).rglob("*") if p.suffix in WEIGHTS and p.is_file())
    of_ours = ["pipelines/depth/completion/weights.npz", "pipelines/labels/shape.npz"]
    assert [p.relative_to(ROOT).as_posix() for p in weights] == of_ours
    sizes = " and ".join(f"{p.stat().st_size / 1e6:.1f}" for p in weights)
    installed = importlib.metadata.files(PROJECT["name"]) or []  # those of the wheel, where it is what is tested
    assert {p.name for p in installed if p.suffix in WEIGHTS and len(p.parts) > 1} <= {p.name for p in weights}
    for page in ("README.md", "docs/index.md"):
        text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
        assert f"Licence: {PROJECT['license']}" in text
        assert f"two small networks that are included ({sizes} MB, of ours" in text
        for name, licence in COPYLEFT.items():
            assert f"`{name}` ({licence})" in text


def test_only_known_packages_are_installed_by_name() -> None:
    """The program's own name may be somebody else's on an index of packages: its wheel or checkout is named by path."""
    extras = PROJECT["optional-dependencies"].values()
    known = {Requirement(text).name for texts in (PROJECT["dependencies"], *extras) for text in texts}
    known -= {PROJECT["name"]}
    files = [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        ROOT / "Dockerfile",
        ROOT / "CHANGELOG.md",
        ROOT / "Makefile",
    ]
    files += [*(ROOT / "docs").glob("*.md"), ROOT / "docs" / "msgs-slam.1"]
    files += [p for room in ("formats", "pipelines", "msgs_cli") for p in (ROOT / room).rglob("*.py")]
    texts = {path: path.read_text(encoding="utf-8").replace("\\-", "-") for path in files}
    own = [str(path) for path, text in texts.items() if re.search(rf"pip install [^\n`]*\b{PROJECT['name']}\b", text)]
    assert own == []
    first = [word for text in texts.values() for word in re.findall(r"pip install (?:-\S+ )*'?([\w.][^'\s`)]*)", text)]
    assert len(first) > 5
    assert {w for w in first if w[0] != "." and "://" not in w and re.split(r"[\[<>=!~]", w)[0] not in known} == set()
