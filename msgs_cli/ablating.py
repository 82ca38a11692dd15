"""`msgs-slam ablate`: what each term of the method earns on a recording."""

from __future__ import annotations

from pathlib import Path

import click

from msgs_slam.msgs_cli.options import (
    FOLDER,
    make_progress,
    set_up_logging,
    settings_options,
    source_options,
    source_settings,
    stopping_softly,
    tell_result,
    verbosity_options,
)
from msgs_slam.msgs_cli.text import say


@click.command()
@click.argument("source", type=click.Path(path_type=Path))
@click.option(
    "--truth", required=True, type=click.Path(path_type=Path, exists=True), metavar="PATH",
    help="A data set with true poses and, if it has them, depth and labels.",
)  # fmt: skip
@click.option("--truth-format", default="auto", help="Layout of the truth; auto recognises it.")
@click.option("--out", "-o", type=FOLDER, metavar="DIR", help="Default: the source's name + .ablation, here.")
@click.option("--seeds", default="0", show_default=True, metavar="N,N,...", help="One run of every row with each seed.")
@click.option("--only", multiple=True, metavar="NAME", help="One row of the table only; may be repeated.")
@click.option(
    "--hold-out", type=click.IntRange(0), default=8, show_default=True, metavar="N",
    help="Keep every N-th frame out of the map, to measure it there; 0 = use all.",
)  # fmt: skip
@settings_options
@source_options
@verbosity_options
def ablate(
    source: Path,
    truth: Path,
    truth_format: str,
    out: Path | None,
    seeds: str,
    only: tuple[str, ...],
    hold_out: int,
    config_file: Path | None,
    overrides: tuple[str, ...],
    quiet: bool,
    verbose: bool,
    **about_source: str | None,
) -> None:
    """Reconstruct SOURCE with the terms of the method switched off, one at a time, and compare with the truth.

    Rows: complete, without proxy depth, without semantic loss, without loops, without depth loss, colour only. Frames
    and proxies are made once. Stopped at any moment, the same command goes on where it was.
    """
    set_up_logging(quiet, verbose)
    from msgs_slam.formats.datasets import open_sequence
    from msgs_slam.pipelines.evaluation.ablation import ABLATIONS, ablate, ablation_table
    from msgs_slam.pipelines.read_config import load_config
    from msgs_slam.pipelines.reconstruct import default_run_folder

    texts = [f"mapping.hold_out={hold_out}", *overrides, *source_settings(about_source)]
    config = load_config(config_file, texts)
    folder = out or default_run_folder(source).root.with_suffix(".ablation")
    numbers = _seeds(seeds)
    with stopping_softly("The same command goes on."):
        result = ablate(
            source, open_sequence(truth, truth_format), folder, config, numbers, make_progress(quiet),
            only or tuple(ABLATIONS),
        )  # fmt: skip
    say(ablation_table(result))
    say(f"also in {folder / 'ablation.md'} and {folder / 'ablation.json'}", err=True)
    tell_result(quiet, table=folder / "ablation.json")


def _seeds(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise click.BadParameter(f"{text!r}: expected numbers like 0,1,2", param_hint="--seeds") from error
