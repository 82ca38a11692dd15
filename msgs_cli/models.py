"""`msgs-slam models`: learned models in the cache."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .output import format_table, terminal_width

if TYPE_CHECKING:
    from ..pipelines.networks.registry import Model, ModelStore


@click.group()
def models() -> None:
    """List and download the learned models for depth and classes. A reconstruction never downloads."""


_WIDTH = 100
"""Characters of a line where the output goes into a file or pipe."""


def _size(model: Model) -> str:
    return f"{model.bytes / 1e6:.1f} MB" if model.bytes else "size unknown"


@models.command("list", short_help="List the known models, what is installed, licences.")
def list_models() -> None:
    """List the known models: which are installed, their sizes and licences.

    \b
    Example: msgs-slam models list
    """
    from ..pipelines.networks.registry import ModelStore

    store, rows = ModelStore.open(), []
    for model in store.models:
        here = store.is_here(model)
        notes = [] if model.commercial else ["ask before commercial use"]
        if model.pull:
            notes.append("`models pull`" if model.pull == "default" else "`models pull --best`")
        if not model.sha256:
            notes.append("hash unknown: --trust")
        elif model.urls and not model.revision:
            notes.append("no fixed revision")
        family = store.families[model.family]
        use = "metres" if family.get("metres_only") else family["task"]
        if here or model.urls:  # of the others there is nothing to pull
            about = "; ".join([model.licence, *notes])
            rows.append((model.name, use, "here" if here else "-", _size(model), about))
    click.echo(format_table(("model", "for", "", "size", "licence"), rows, terminal_width() or _WIDTH))
    click.echo(f"cache: {store.cache}")


@models.command(short_help="Download models, by default the small ones (4 MB).")
@click.argument("names", nargs=-1)
@click.option(
    "--best", is_flag=True, help="The small ones and a large one for metric depth, free for all uses (145 MB)."
)
@click.option(
    "--from", "folder", type=click.Path(path_type=Path),
    help="Take the files from this folder, under any file names, instead of the network.",
)  # fmt: skip
@click.option(
    "--trust", is_flag=True,
    help="Accept a model without a published sha256 (DINOv2's head), and remember the hash of the downloaded file.",
)  # fmt: skip
@click.option("--offline", is_flag=True, help="Only check what is installed; download nothing.")
@click.option("--yes", is_flag=True, help="Do not ask about the licences.")
def pull(names: tuple[str, ...], best: bool, folder: Path | None, trust: bool, offline: bool, yes: bool) -> None:
    """Download models by name, with what they need; without a name the small ones (4 MB): classes, metres, people.

    A file is installed only if its SHA-256 is right.

    \b
    Example: msgs-slam models pull --yes
    """
    from ..formats.errors import InputError
    from ..pipelines.networks.registry import ModelStore

    store = ModelStore.open()
    if folder is not None:
        wanted = store.with_needed(names, best) if names or best else list(store.models)
        found = store.take(folder, wanted)
        if not found or (names and len(found) < len(wanted)):
            missed = ", ".join(m.name for m in wanted if m not in found)
            raise InputError(f"{folder}: holds no file of {missed}, by its sha256 (`msgs-slam models list`)")
        for model in found:
            click.echo(str(store.path(model)))
        return
    wanted = store.with_needed(names, best)
    lacking = [m for m in wanted if not store.is_here(m)]
    if lacking and not offline:
        store.require_pullable(lacking, trust)
        for model in lacking:
            click.echo(f"{model.name}: {_size(model)}, licence: {model.licence}")
        if not yes:
            click.confirm("Download?", default=True, abort=True)
    for model in wanted:
        click.echo(str(_pull_one(store, model, trust, offline)))


def _pull_one(store: ModelStore, model: Model, trust: bool, offline: bool) -> Path:
    from tqdm import tqdm

    bars: list[tqdm] = []  # none before something arrives: an error stands on a line of its own

    def show(done: int, size: int) -> None:
        if not bars:
            bars.append(tqdm(total=model.bytes, unit="B", unit_scale=True, desc=model.name, leave=False))
        bars[0].n = done
        bars[0].refresh()
        if done == size:
            bars[0].close()

    try:
        return store.pull(model, show, trust, offline)
    finally:
        for bar in bars:
            bar.close()


@models.command()
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "--family",
    required=True,
    help="Its family, such as metric3d-community or moge.",
)
@click.option("--name", default="", help="Its name in the cache; by default the file's own.")
def add(file: Path, family: str, name: str) -> None:
    """Install your own ONNX or TFLite file as a model of a known family.

    \b
    Example: msgs-slam models add depth.onnx --family moge
    """
    from ..pipelines.networks.registry import ModelStore

    model = ModelStore.open().add(file, family, name)
    click.echo(f"{model.name}: sha256 {model.sha256}")


@models.command(short_help="Check every installed file against its hash.")
def verify() -> None:
    """Check every installed file against its hash; exit code 1 if one is damaged.

    \b
    Example: msgs-slam models verify
    """
    from ..pipelines.networks.registry import ModelStore

    found = ModelStore.open().verify()
    width = max(map(len, found))
    for name, state in found.items():
        click.echo(f"{name:{width}}  {state}")
    if any(state.startswith("damaged") for state in found.values()):
        raise SystemExit(1)


@models.command()
@click.argument("name")
def path(name: str) -> None:
    """Print the path of a model's file.

    \b
    Example: msgs-slam models path fast-depth
    """
    from ..formats.errors import InputError
    from ..pipelines.networks.registry import ModelStore

    store = ModelStore.open()
    model = store.get(name)
    if not store.is_here(model):
        raise InputError(f"{name} is not in {store.cache}; run: msgs-slam models pull {name}")
    click.echo(str(store.path(model)))
