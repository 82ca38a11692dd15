"""`msgs-slam models`: learned models in the cache."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from pipelines.proxy.models.registry import Model


@click.group()
def models() -> None:
    """List, download and check the learned models for depth and classes. A reconstruction never downloads."""


def _size(model: Model) -> str:
    return f"{model.bytes / 1e6:.1f} MB" if model.bytes else "size unknown"


@models.command("list")
def list_models() -> None:
    """Every known model: whether it is here, its size and its licence."""
    from pipelines.proxy.models.registry import ModelStore

    store = ModelStore.open()
    for model in store.models:
        here = "here" if store.is_here(model) else "-"
        notes = ["commercial use allowed" if model.commercial else "ask before commercial use"]
        if not model.sha256:
            notes.append("hash unknown: pull with --trust")
        elif model.urls and not model.revision:
            notes.append("no fixed revision: refused if its makers replace it")
        task = store.families[model.family]["task"]
        click.echo(f"{model.name:18} {task:13} {here:5} {_size(model):>12}  {model.licence} ({'; '.join(notes)})")
    click.echo(f"cache: {store.cache}")


@models.command()
@click.argument("names", nargs=-1)
@click.option("--trust", is_flag=True, help="Accept a model of unknown sha256 and record the hash of what comes.")
@click.option("--offline", is_flag=True, help="Only check what is here; download nothing.")
@click.option("--yes", is_flag=True, help="Do not ask about the licence.")
def pull(names: tuple[str, ...], trust: bool, offline: bool, yes: bool) -> None:
    """Download models by name, with what they need; without a name those for metric depth and named classes.

    A broken download goes on where it stopped.
    """
    from tqdm import tqdm

    from pipelines.proxy.models.registry import ModelStore

    store = ModelStore.open()
    for model in store.with_needed(names):
        if not store.is_here(model) and not offline:
            click.echo(f"{model.name}: {_size(model)}, licence: {model.licence}")
            if not yes:
                click.confirm("Download it?", default=True, abort=True)
        with tqdm(total=model.bytes, unit="B", unit_scale=True, desc=model.name, leave=False) as bar:

            def show(done: int, size: int, bar: tqdm = bar) -> None:
                bar.n = done
                bar.refresh()

            path = store.pull(model, show, trust, offline)
        click.echo(str(path))


@models.command()
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--family", required=True, help="Which contract it keeps, for example metric3d-community or moge.")
@click.option("--name", default="", help="Its name in the cache; by default the file's own.")
def add(file: Path, family: str, name: str) -> None:
    """Copy your own ONNX file into the cache as a model of a known family."""
    from pipelines.proxy.models.registry import ModelStore

    model = ModelStore.open().add(file, family, name)
    click.echo(f"{model.name}: sha256 {model.sha256}")


@models.command()
def verify() -> None:
    """Compare every file in the cache with its hash; exit code 1 when one is damaged."""
    from pipelines.proxy.models.registry import ModelStore

    found = ModelStore.open().verify()
    for name, state in found.items():
        click.echo(f"{name:16} {state}")
    if any(state.startswith("damaged") for state in found.values()):
        raise SystemExit(1)


@models.command()
@click.argument("name")
def path(name: str) -> None:
    """Print where a model's file lies."""
    from formats.errors import InputError
    from pipelines.proxy.models.registry import ModelStore

    store = ModelStore.open()
    model = store.get(name)
    if not store.is_here(model):
        raise InputError(f"{name} is not in {store.cache}; type: msgs-slam models pull {name}")
    click.echo(str(store.path(model)))
