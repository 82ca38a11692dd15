"""From a source to a finished run: what the commands `reconstruct`, `resume` and `status` do."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from formats.atomic import atomic_path
from formats.digest import file_sha256, files_sha256
from formats.errors import DiskFullError, InputError
from formats.jsonfile import write_json
from pipelines.config import Config, config_to_toml, load_saved_config
from pipelines.frames.recording import open_recording
from pipelines.progress import Progress, log
from pipelines.run_folder import RunFolder
from pipelines.run_folder_names import STAGES
from pipelines.stages import Stage, StageRecord, load_records, load_source, run_stages


def all_stages() -> list[Stage]:
    """The stages in order. Imported here so that asking for help does not load torch."""
    from pipelines.export.stage import STAGE as export
    from pipelines.frames.stage import STAGE as frames
    from pipelines.global_ba.stage import STAGE as global_ba
    from pipelines.mapping.stage import STAGE as mapping
    from pipelines.proxy.stage import STAGE as proxy
    from pipelines.tracking.stage import STAGE as tracking

    return [frames, proxy, tracking, mapping, global_ba, export]


def default_run_folder(source: Path) -> RunFolder:
    """`video.msgs` in the working folder for `…/video.mp4`."""
    name = source.resolve().stem if source.is_file() else source.resolve().name
    return RunFolder(Path(f"{name}.msgs"))


def existing_config(run: RunFolder) -> Config | None:
    """The settings a run was made with, or None where there is no run."""
    return load_saved_config(run.settings_file) if run.settings_file.exists() else None


def reconstruct(
    source: Path, run: RunFolder, config: Config, progress: Progress, until: str = STAGES[-1]
) -> dict[str, StageRecord]:
    """Make, or bring up to date, the run of `source`.

    Raises InputError for a source that cannot be used and for a folder that holds something else; a folder made by
    this call is removed again when the source turns out to be unusable.
    """
    digest = _source_digest(source, config.run.format)
    is_new = not run.root.exists()
    if not is_new:
        _require_same_source(run, source, digest)
    config = _with_device(config)
    run.root.mkdir(parents=True, exist_ok=True)
    try:
        with _only_one_process(run):
            if not run.manifest_file.exists():
                write_json(
                    run.manifest_file, {"source": {"path": str(source.resolve()), "digest": digest}, "stages": {}}
                )
            with atomic_path(run.settings_file) as temporary:
                temporary.write_text(config_to_toml(config), encoding="utf-8")
            return _run(run, source, digest, config, progress, until)
    except InputError as error:
        if is_new and not isinstance(error, DiskFullError) and not load_records(run):
            shutil.rmtree(run.root)
        raise


def resume(
    run: RunFolder, progress: Progress, config: Config | None = None, until: str = STAGES[-1]
) -> dict[str, StageRecord]:
    """Go on with a run from its own settings, or from `config`."""
    require_run(run)
    origin = load_source(run)
    source = Path(origin["path"])
    config = config or load_saved_config(run.settings_file)
    if "frames" not in load_records(run) and _source_digest(source, config.run.format) != origin["digest"]:
        raise InputError(
            f"{source} has changed since {run.root} was begun. Reconstruct it into another folder: --out NEW"
        )
    config = _with_device(config)
    with _only_one_process(run):
        with atomic_path(run.settings_file) as temporary:
            temporary.write_text(config_to_toml(config), encoding="utf-8")
        return _run(run, source, origin["digest"], config, progress, until)


def require_run(run: RunFolder) -> None:
    """Raise InputError unless the folder holds a run."""
    if not run.manifest_file.exists() or not run.settings_file.exists():
        raise InputError(
            f"{run.root} is not a run folder (it has no manifest.json). Runs are made by `msgs-slam reconstruct VIDEO`"
        )


def _run(
    run: RunFolder, source: Path, digest: str, config: Config, progress: Progress, until: str
) -> dict[str, StageRecord]:
    _set_threads(config.run.threads or os.cpu_count() or 1)
    return run_stages(all_stages(), run, source, digest, config, progress, until)


def _source_digest(source: Path, format: str) -> str:
    """Identity of a source: its bytes; for a folder the names and bytes of its files, for a data set of its images."""
    if source.is_file() and source.stat().st_size == 0:
        raise InputError(f"{source} is empty (0 bytes). Copy the video again")
    if not source.exists():
        raise InputError(f"{source}: there is no such file or folder. Give a video or a folder of images")
    recording = open_recording(source, format)
    if recording is not None and recording.image_paths:
        head = f"{recording.format} {recording.camera}".encode() + recording.timestamps.tobytes()
        return files_sha256(zip(recording.names, recording.image_paths, strict=True), head)
    if source.is_file():
        return file_sha256(source)
    return files_sha256((p.name, p) for p in sorted(source.iterdir()) if p.is_file())


def _require_same_source(run: RunFolder, source: Path, digest: str) -> None:
    if not run.root.is_dir():
        raise InputError(f"{run.root} is a file; the run needs a folder. Choose another with --out FOLDER")
    if not run.manifest_file.exists():
        if any(run.root.iterdir()):
            raise InputError(f"{run.root} exists and is not a run folder. Choose another with --out FOLDER")
        return
    origin = load_source(run)
    if origin["digest"] != digest:
        raise InputError(
            f"{run.root} is the run of another source ({origin['path']}), not of {source}. "
            "Choose another folder with --out FOLDER, or delete it"
        )


def _with_device(config: Config) -> Config:
    """Settle `auto`, and refuse a GPU that is not there."""
    import torch

    wanted = config.run.device
    if wanted == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "--device cuda: torch finds no CUDA device here. Use --device cpu, or install a CUDA build of torch"
        )
    if wanted == "auto":
        wanted = "cuda" if torch.cuda.is_available() else "cpu"
        log.info("device: %s", wanted)
    return replace(config, run=replace(config.run, device=wanted))


def _set_threads(threads: int) -> None:
    import cv2
    import torch

    from pipelines.gaussians.render import set_threads

    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    set_threads(threads)


@contextmanager
def _only_one_process(run: RunFolder) -> Iterator[None]:
    """Hold the run's lock. The system releases it when the process ends, however it ends."""
    try:
        import fcntl
    except ImportError:  # Windows has no flock; two processes on one run are then the user's to avoid.
        yield
        return
    with (run.root / ".lock").open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(
                f"{run.root}: another msgs-slam process is working on this run. Wait for it to end"
            ) from error
        yield
