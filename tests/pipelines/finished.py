"""Run folders whose stages are done by other means than running them."""

from collections.abc import Iterable

from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.run.ending import results
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.manifest import Manifest, Source, content_digest, settings_of, write_manifest
from msgs_slam.pipelines.run.reads import Reads, StageRecord


def note_finished(
    run: RunFolder, stages: Iterable[str], config: Config | None = None, source: str = "", seconds: float = 0.0
) -> None:
    """run.toml, and a manifest that takes what lies in these stages' folders for their results."""
    config = config or Config()
    records = {}
    for name in stages:
        files = results(run.stage(name))
        content, settings = content_digest(files), settings_of(config, name)
        records[name] = StageRecord(Reads(), files, seconds, 50 * seconds, {}, [], content, settings)
    write_manifest(run.manifest_file, Manifest(Source(source, ""), records))
    run.save_settings(config)
