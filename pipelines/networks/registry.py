"""The table of models, the cache folder that holds their files, and how they are downloaded."""

from __future__ import annotations

import errno
import functools
import logging
import os
import re
import shutil
import tomllib
import urllib.parse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from ...formats.atomic import atomic_path
from ...formats.errors import DiskFullError, InputError
from ...formats.reading import file_sha256, parsing, reaching, require_file, user_cache
from ...formats.textfile import read_json_object, write_json
from ..system.progress import log
from ..system.values import dataclass_from_json
from .card import Card, card_from_values

_TABLE = Path(__file__).with_name("registry.toml")
_NOT_IN_CARDS = ("suffix", "ade20k", "metres_only")
"""Keys of a family that are the table's own."""
_ADE20K = Path(__file__).with_name("ade20k.toml")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


@dataclass(frozen=True)
class Model:
    """One row of the table. `sha256` is "" and `bytes` 0 while unknown; `needs` names another model it works with.

    `revision` is the commit that the addresses name, "" where they name a branch whose file may be replaced. `pull`
    says what brings it without its name: "default" every pull, "best" one of the large ones, too.
    """

    name: str
    family: str
    bytes: int
    sha256: str
    licence: str
    commercial: bool
    urls: tuple[str, ...] = ()
    needs: str = ""
    revision: str = ""
    pull: str = ""


@dataclass(frozen=True)
class _Own:
    """What the user has brought, own.json in the cache: hashes of files that were trusted, by the names of their rows,
    and models of the user's own."""

    pinned: dict[str, str] = field(default_factory=dict)
    added: list[Model] = field(default_factory=list)


@dataclass(frozen=True)
class ModelStore:
    """Known models over a cache folder."""

    cache: Path
    models: tuple[Model, ...]
    families: dict[str, dict[str, Any]]

    @staticmethod
    def open(cache: Path | None = None, table: Path = _TABLE) -> ModelStore:
        """The store of this user. `MSGS_SLAM_CACHE` names another cache folder."""
        values = _parsed(table.read_text(encoding="utf-8"))
        store = ModelStore(cache or default_cache(), (), values["family"])
        own, rows = store._load_own(), []
        for row in values["model"]:
            urls = tuple(url.format(revision=row.get("revision") or "main") for url in row["urls"])
            rows.append(Model(**{**row, "urls": urls, "sha256": row["sha256"] or own.pinned.get(row["name"], "")}))
        return replace(store, models=(*own.added, *rows))

    def path(self, model: Model) -> Path:
        """Return the path of the model's file, whether it exists or not."""
        return self.cache / f"{model.name}{self.families[model.family].get('suffix', '.onnx')}"

    def is_here(self, model: Model) -> bool:
        """Whether the file is there with the right size (the content is checked when it is opened)."""
        path = self.path(model)
        whole = path.is_file() and path.stat().st_size == (model.bytes or path.stat().st_size) and bool(model.sha256)
        return whole and (not model.needs or self.is_here(self.get(model.needs)))

    def get(self, name: str) -> Model:
        """Raises InputError for an unknown name."""
        found = {model.name: model for model in reversed(self.models)}
        if name not in found:
            raise InputError(f"there is no model {name!r}; known: {', '.join(m.name for m in self.models)}")
        return found[name]

    def with_needed(self, names: Sequence[str], best: bool = False) -> list[Model]:
        """The named models and those they work with; without names the small ones, and with `best` the large ones."""
        wanted = ("default", "best") if best else ("default",)
        chosen = [self.get(n) for n in names] if names else [m for m in self.models if m.pull in wanted]
        both = [m for model in chosen for m in (model, *([self.get(model.needs)] if model.needs else []))]
        return list(dict.fromkeys(both))

    def card(self, model: Model) -> Card:
        """The contract of the model's family, for its file in the cache."""
        values = self._contract(model.family) | {"model": self.path(model), "sha256": model.sha256}
        if model.needs:
            values["head"] = self.path(self.get(model.needs))
        return card_from_values(values, _TABLE)

    def _contract(self, family: str) -> dict[str, Any]:
        """The keys of a family's card."""
        values = {k: v for k, v in self.families[family].items() if k not in _NOT_IN_CARDS}
        count = self.families[family].get("ade20k")
        return values | (_room_classes(count) if count else {})

    def first_here(self, task: str, metres_only: bool = False) -> Model | None:
        """The best model of a task whose file is in the cache; with `metres_only` also one that is good for nothing
        but the scale."""
        return next(self.all_here(task, metres_only), None)

    def all_here(self, task: str, metres_only: bool = False) -> Iterator[Model]:
        """Every model of a task whose file is in the cache, best first, as `first_here` counts them."""
        for model in self.models:
            family = self.families[model.family]
            if family["task"] == task and self.is_here(model) and (metres_only or not family.get("metres_only")):
                yield model

    def first_metric(self) -> Model | None:
        """The best network for metric depth in the cache: by itself, or as its training camera saw them."""
        families = {m: self.families[m.family] for m in self.all_here("depth", metres_only=True)}
        return next((m for m, keys in families.items() if not keys.get("relative") or "focal" in keys), None)

    def take(self, folder: Path, models: Sequence[Model]) -> list[Model]:
        """Copy the files of `models` that are in `folder` into the cache; they are known by their content, whatever
        they are called. Returns those that were found. Raises InputError when there is no such folder."""
        of_size: dict[int, list[Path]] = {}
        with reaching(folder):
            files = sorted(p for p in folder.iterdir() if p.is_file())
        for file in files:
            of_size.setdefault(file.stat().st_size, []).append(file)
        found = []
        for model in models:
            same = (f for f in of_size.get(model.bytes, []) if model.sha256 and file_sha256(f) == model.sha256)
            if (source := next(same, None)) is not None:
                with atomic_path(self.path(model)) as temporary:
                    shutil.copyfile(source, temporary)
                found.append(model)
        return found

    def _is_whole(self, model: Model) -> bool:
        path = self.path(model)
        return bool(model.sha256) and path.is_file() and file_sha256(path) == model.sha256

    def require_pullable(self, models: Sequence[Model], trust: bool = False) -> None:
        """Raise InputError for a model that is not here and cannot be downloaded: it has no address, or its hash is
        unknown and `trust` does not accept what comes."""
        for model in (m for m in models if not self._is_whole(m)):
            if not model.urls:
                raise InputError(
                    f"{model.name} has no address. Bring its file: msgs-slam models pull {model.name} --from FOLDER"
                )
            if not model.sha256 and not trust:
                raise InputError(
                    f"{model.name}: nobody has published its sha256, so what is downloaded cannot be checked. Pull it "
                    "with --trust to accept the first download, whose hash is kept. Nothing was downloaded"
                )

    def pull(
        self, model: Model, progress: Callable[[int, int], None], trust: bool = False, offline: bool = False
    ) -> Path:
        """Download the model's file unless it is here and whole; a row without a hash only with `trust`, which pins it.

        Raises InputError when no mirror delivers it, when it is not what the table says, and when offline.
        """
        path = self.path(model)
        if self._is_whole(model):
            return path
        self.require_pullable([model], trust)
        if offline:
            raise InputError(
                f"{model.name} is not in {self.cache} and this is offline. Pull it where there is a network"
            )
        try:
            actual = fetch(model.urls, path, model.bytes, model.sha256, progress)
        except InputError as error:
            if model.revision or not model.sha256 or "expected" not in str(error):
                raise
            raise InputError(
                f"{error}\nIts makers may have replaced the file since its hash was recorded. If you trust the new "
                f"one, download it yourself and run: msgs-slam models add FILE --family {model.family}"
            ) from error
        if not model.sha256:
            own = self._load_own()
            self._save_own(replace(own, pinned=own.pinned | {model.name: actual}))
        return path

    def add(self, file: Path, family: str, name: str = "") -> Model:
        """Copy the user's own file into the cache as a model of `family`. InputError unless it fits the family."""
        known = [name for name, keys in self.families.items() if "input" in keys and name != "dinov2-ade20k"]
        if family not in known:
            raise InputError(f"there is no family {family!r}; known: {', '.join(known)}")
        require_file(file)
        from .session import Network

        digest, size = file_sha256(file), file.stat().st_size
        model = Model(name or file.stem, family, size, digest, "the user's own file", False)
        own = self._load_own()
        if model.name in {m.name for m in self.models} - {m.name for m in own.added}:
            raise InputError(f"{model.name} is the name of a known model. Give another with --name")
        if not _NAME.fullmatch(model.name):
            raise InputError(f"{model.name!r} is no name for a model: letters, digits, dot, dash and underscore")
        values = self._contract(family) | {"model": file.resolve(), "sha256": digest}
        Network(card_from_values(values, _TABLE), 1, "cpu")
        with atomic_path(self.path(model)) as temporary:
            shutil.copyfile(file, temporary)
        self._save_own(replace(own, added=[m for m in own.added if m.name != model.name] + [model]))
        return model

    def verify(self) -> dict[str, str]:
        """Name → "ok", "not installed" or what is wrong, for every model."""
        return {model.name: self._state(model) for model in self.models}

    def _state(self, model: Model) -> str:
        if not self.path(model).is_file():
            return "not installed"
        if not model.sha256:
            return "no known sha256"
        return "ok" if self._is_whole(model) else "damaged: pull it again"

    def _load_own(self) -> _Own:
        path = self.cache / "own.json"
        with reaching(path):
            if not path.exists():
                return _Own()
        with parsing(path, "list of your models", "delete it and add them again (msgs-slam models add)"):
            own = dataclass_from_json(_Own, read_json_object(path))
            if bad := [m.name for m in own.added if not _NAME.fullmatch(m.name) or m.family not in self.families]:
                raise ValueError(f"{bad[0]!r} is no model of a known family")
            return own

    def _save_own(self, own: _Own) -> None:
        write_json(self.cache / "own.json", asdict(own))


@functools.cache
def _parsed(text: str) -> dict[str, Any]:
    return tomllib.loads(text)


def metric_card() -> Card | None:
    """The card of the best network in the cache for metric depth, be it good for nothing else; None without one."""
    store = ModelStore.open()
    return None if (model := store.first_metric()) is None else store.card(model)


def missing_networks() -> str | None:
    """One line on what the default networks would add where there are none; None where there are."""
    store = ModelStore.open()
    lacks = [
        what
        for what, task in (("class names", "segmentation"), ("metric scale", "depth"), ("person masks", "person"))
        if store.first_here(task, metres_only=True) is None
    ]
    size = sum(m.bytes for m in store.with_needed([])) / 1e6
    named = f"Optional networks not installed ({', '.join(lacks)}; {size:.0f} MB): msgs-slam models pull"
    return named if lacks else None


def _room_classes(count: int) -> dict[str, list[str]]:
    """The first `count` of ADE20K's classes, "other" before them unless it is all of them, and for each the kind of
    thing in a room that it counts for."""
    values = tomllib.loads(_ADE20K.read_text(encoding="utf-8"))
    kind_of = {name: kind for kind, names in values["groups"].items() for name in names}
    names = values["classes"] if count == len(values["classes"]) else ["other", *values["classes"][:count]]
    return {"classes": names, "groups": [kind_of.get(name, "other") for name in names]}


def default_cache() -> Path:
    """`$MSGS_SLAM_CACHE`, else `msgs-slam` in the user's cache folder. Raises InputError where there is neither."""
    if own := os.environ.get("MSGS_SLAM_CACHE"):
        return Path(own)
    if (place := user_cache()) is None:
        raise InputError(
            "this user has no home folder, in which networks would be kept: set MSGS_SLAM_CACHE to a folder for them"
        )
    return place / "msgs-slam"


_CHUNK = 1 << 18
_MAX_UNKNOWN = 1 << 30
_TIMEOUT = 30.0
_ATTEMPTS = 3
_OWN_HOSTS = ("127.0.0.1", "localhost", "::1")


def fetch(urls: Sequence[str], target: Path, size: int, sha256: str, progress: Callable[[int, int], None]) -> str:
    """Download the first of `urls` that delivers `size` bytes of the right hash to `target`; returns the hash.

    A `size` of 0 is unknown, an empty `sha256` accepts any content. `progress(done, size)` is called as bytes arrive.
    Raises InputError when every mirror fails, with the reason of each.
    """
    if target.is_dir():
        raise InputError(f"{target} is a folder where a file should be: remove it, or choose another cache folder")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)  # without a known hash, pooch keeps what is there
    except OSError as error:
        raise InputError(f"cannot write {target.parent} ({error.strerror}): choose another cache folder") from error
    reasons: list[str] = []
    for url in urls:
        if not _is_safe(url):
            raise InputError(f"{url}: only https addresses are downloaded from")
        if not (reason := _fetch_one(url, target, size, sha256, progress)):
            if reasons:
                log.warning("%s came from %s: %s", target.name, url, "; ".join(reasons))
            return sha256 or file_sha256(target)
        reasons.append(f"{url}: {reason}")
    raise InputError(
        f"{target.name} could not be downloaded from any address:\n  "
        + "\n  ".join(reasons)
        + "\nCheck the network and try again, or download the file elsewhere into a folder, under any name, and then: "
        "msgs-slam models pull --from FOLDER"
    )


def _fetch_one(url: str, target: Path, size: int, sha256: str, progress: Callable[[int, int], None]) -> str:
    """Download from one address, again where the connection breaks; returns why it failed, or ""."""
    import pooch
    import requests

    pooch.get_logger().setLevel(logging.WARNING)
    known, reason = f"sha256:{sha256}" if sha256 else None, ""
    for _ in range(_ATTEMPTS):
        downloader = pooch.HTTPDownloader(
            progressbar=_Bar(size, progress), chunk_size=_CHUNK, timeout=_TIMEOUT, hooks={"response": _require_safe}
        )
        try:
            pooch.retrieve(url, known, target.name, target.parent, downloader=downloader)
            return ""
        except requests.HTTPError as error:
            return f"the server answers {str(error).partition(' for url')[0]}"
        except requests.RequestException as error:
            cause = getattr(error.args[0], "reason", error) if error.args else error  # without the address again
            reason = re.sub(r"^\w+\(.*?\): ", "", str(cause))
        except (ValueError, InputError) as error:
            return str(error)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                raise
            raise DiskFullError(
                f"the disk is full: {target.parent} needs {size / 1e6:.0f} MB. Free some space and pull again"
            ) from error
    return reason


class _Bar:
    """pooch's progress bar: tells how far a download is, and ends one that sends more than it should."""

    def __init__(self, size: int, progress: Callable[[int, int], None]) -> None:
        self.size, self.progress, self.total, self.done = size, progress, size, 0

    def update(self, count: int) -> None:
        if self.size and self.total not in (0, self.size):
            raise InputError(f"the file there has {self.total} bytes, expected {self.size}")
        self.done += count
        if self.done - _CHUNK > (self.size or _MAX_UNKNOWN):
            raise InputError(f"more than the expected {self.size or _MAX_UNKNOWN} bytes came")
        size = self.size or self.total or self.done
        self.progress(min(self.done, size), size)

    def reset(self) -> None:
        self.done = 0

    def close(self) -> None:
        pass


def _is_safe(url: str, from_own_host: bool = True) -> bool:
    """https, or plain http to this machine: no line in between, where anybody could change what comes."""
    try:
        parts = urllib.parse.urlsplit(url)
        host = parts.hostname or ""
    except ValueError:
        return False
    return bool(host) and (parts.scheme == "https" or (parts.scheme == "http" and host in _OWN_HOSTS and from_own_host))


def _require_safe(response: Any, *_: Any, **__: Any) -> None:
    """Follow redirects to where a download may begin; from elsewhere never to this machine."""
    location = urllib.parse.urljoin(response.url, response.headers.get("location", ""))
    own = (urllib.parse.urlsplit(response.url).hostname or "") in _OWN_HOSTS
    if response.is_redirect and not _is_safe(location, own):
        raise InputError(f"the server redirects to {location[:200]}; only https is followed")
