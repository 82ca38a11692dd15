"""Status of a run, for people and for programs."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..formats.errors import InputError
from .config import STAGES, Config, ProxyConfig
from .engine.stages import Stage
from .engine.staleness import changed_auto_choices, next_upstream, rerun_reason
from .mapping.division import submap_count
from .masks.people import people_cards
from .networks.card import Card
from .networks.registry import ModelStore, metric_card
from .proxy.selection import choose_depth, choose_semantics
from .run.files import CALIBRATION
from .run.folder import RunFolder, load_records, load_settings, load_source, load_stale, why_not_done
from .run.lock import RunProgress, load_run_progress
from .run.manifest import StageRecord, differing_settings
from .system.memory import ALIGNED_TOGETHER, GAUSSIANS, NEEDS, memory_room, submap_size, window_size, windows_of
from .system.wording import quoted

_BEYOND = 0.3
"""MB for each keyframe that `frames` or tracking has not in work."""
DONE, RUNNING, DAMAGED, INTERRUPTED = "done", "running", "damaged", "interrupted"
OUTDATED, NOT_YET = "outdated", "not yet"

Program = Callable[[str], Sequence[Stage]]
"""The stages of a method (`run.method`), in order."""


@dataclass(frozen=True)
class StageStatus:
    """state: done; running (a process makes it now); damaged (done, but some of its files are gone or not as it left
    them); interrupted (started and not ended); outdated (its files are there, but were made with other settings or from
    other inputs than the stages before it have by now); not yet. record: of a stage that is done; changed: settings of
    run.toml, as `section.key=value`, with which `resume` would make it again; damaged: names of those files;
    expected_mb: the peak of memory that other recordings of that size have had, None before the keyframes are known;
    again: why `resume` would make it again, where nothing above says so; newer: what `auto` would choose otherwise by
    now, and `resume` leaves as it is; networks: the names of those that it would choose, where there are any; running:
    how far the process is that makes it now."""

    name: str
    state: str
    record: StageRecord | None
    changed: tuple[str, ...] = ()
    damaged: tuple[str, ...] = ()
    expected_mb: float | None = None
    again: str = ""
    newer: tuple[str, ...] = ()
    networks: tuple[str, ...] = ()
    running: RunProgress | None = None

    @property
    def state_text(self) -> str:
        """The state, and of a stage that is being made how far it is."""
        return self.running.text if self.running else self.state


@dataclass(frozen=True)
class RunStatus:
    """source: the path that the run was made from; stages: all of them, in order; planned_mb: the memory that windows
    are chosen by, `run.memory_mb` or half of this machine's."""

    run: RunFolder
    source: str
    stages: tuple[StageStatus, ...]
    planned_mb: float

    @property
    def memory(self) -> str:
        """Memory that stages plan with here, and the highest peak of the finished ones, in words."""
        peaks = {s.name: s.record.peak_memory_mb for s in self.stages if s.record}
        most = max(peaks, key=lambda name: peaks[name], default="")
        budget = f"budget {self.planned_mb / 1000:.1f} GB"
        return f"memory: peak {peaks[most] / 1000:.1f} GB in {most} ({budget})" if most else f"memory: {budget}"

    @property
    def warnings(self) -> list[str]:
        """Faults of the run itself, each with the command that repairs it."""
        again = f"`msgs-slam resume {quoted(self.run.root)}` makes it and what follows again"
        changed = [
            f"{s.name} was made with other settings than run.toml asks for by now ({', '.join(s.changed)}): {again}"
            for s in self.stages
            if s.changed
        ]
        damaged = [
            f"{s.name}: its folder is gone: {again}"
            if not self.run.stage(s.name).exists()
            else f"{s.name}: {len(s.damaged)} of its {len(s.record.files)} files are missing or damaged "
            f"({', '.join(s.damaged[:5])}{', ...' if len(s.damaged) > 5 else ''}): {again}"
            for s in self.stages
            if s.damaged and s.record
        ]
        file = self.run.settings_file
        gone = [] if file.exists() else [f"{file} is gone: stages that are not done get default settings"]
        other = [f"{s.name} was made otherwise ({s.again}): {again}" for s in self.stages if s.again]
        return gone + changed + damaged + other

    @property
    def notes(self) -> list[str]:
        """Remarks on the run that are no fault."""
        new = {s.name: s.networks for s in self.stages if s.newer and s.networks}
        seconds = {s.name: s.record.seconds for s in self.stages if s.record}
        gone = [f"{s.name} ({', '.join(s.newer)})" for s in self.stages if s.newer and not s.networks]
        kept = f"networks that were used are not installed any more, their results are kept: {', '.join(gone)}"
        older = [f"older results are kept: {why_not_done(self.run, name)}" for name in list(load_stale(self.run))[:1]]
        return older + ([_about_networks(self.run, new, seconds)] if new else []) + ([kept] if gone else [])

    def to_json(self) -> dict[str, Any]:
        """Plain values; the records without their lists of files."""
        stages = []
        for s in self.stages:
            record = {k: v for k, v in asdict(s.record).items() if k != "files"} if s.record else None
            stages.append(
                {"name": s.name, "state": s.state, "changed": s.changed, "damaged": s.damaged, "record": record,
                 "expected_mb": s.expected_mb, "again": s.again, "newer": s.newer,
                 "networks": s.networks, "progress": asdict(s.running) if s.running else None}
            )  # fmt: skip
        return {
            "run": str(self.run.root),
            "source": self.source,
            "planned_mb": round(self.planned_mb),
            "stages": stages,
            "warnings": self.warnings,
            "notes": self.notes,
        }


def run_status(run: RunFolder, program: Program = lambda method: ()) -> RunStatus:
    """Reads every file of the run once, to find damaged ones; with the stages of the `program`, reports too what it
    would make again, and why.

    Raises InputError where the manifest or the settings are damaged.
    """
    records, config = load_records(run), load_settings(run)
    again, newer = _compared(run, program(config.run.method), records, config)
    running = load_run_progress(run)
    stages = []
    for name in STAGES:
        record = records.get(name)
        changed = tuple(differing_settings(record, config)) if record else ()
        damaged = tuple(run.damaged(name)) if record else ()
        expected = expected_mb(name, run, config) if "frames" in records else None
        state, why = _state(run, name, record, damaged), "" if changed or damaged else again.get(name, "")
        now = running if running and running.stage == name and record is None else None
        state = RUNNING if now else state
        chosen = newer.get(name, ())
        networks = networks_chosen(chosen)
        stages.append(StageStatus(name, state, record, changed, damaged, expected, why, chosen, networks, now))
    return RunStatus(run, load_source(run).path, tuple(stages), memory_room(config.run.memory_mb) / 1e6)


def _compared(
    run: RunFolder, program: Sequence[Stage], records: dict[str, StageRecord], config: Config
) -> tuple[dict[str, str], dict[str, tuple[str, ...]]]:
    """By stage: why it would be made again, the first such one only; and what `auto` would choose otherwise."""
    origin = load_source(run)
    upstream, again, newer = origin.digest, {}, {}
    for stage in program:
        if (record := records.get(stage.name)) is None:
            break
        try:
            inputs = stage.inputs(Path(origin.path), config) if stage.inputs else None
        except InputError:  # gone: it keeps what it was made from
            inputs = record.inputs
        if why := rerun_reason(stage, run, record, config, upstream, inputs):
            again[stage.name] = why
            break
        newer[stage.name] = tuple(changed_auto_choices(stage, config, record, inputs))
        upstream = next_upstream(upstream, record)
    return again, newer


def networks_chosen(inputs: Iterable[str]) -> tuple[str, ...]:
    """Names of the networks in the cache that `auto` chooses for these inputs of stages."""
    proxy, people = ProxyConfig(), people_cards(ModelStore.open())
    cards: dict[str, list[Card | None]] = {
        "people": [people.person, people.classes] if people else [],
        "depth": [choose_depth(proxy).card],
        "labels": [choose_semantics(proxy).card],
        "metres": [metric_card()],
    }
    return tuple(dict.fromkeys(card.model.stem for name in inputs for card in cards[name] if card is not None))


def about_new_networks(run: RunFolder, program: Program) -> str:
    """Say which networks have been installed since the run's stages were made, and how to use them; "" without any."""
    records, config, source = load_records(run), load_settings(run), Path(load_source(run).path)
    added: dict[str, tuple[str, ...]] = {}
    for stage in program(config.run.method):
        if (record := records.get(stage.name)) is None or not stage.auto(config):
            continue
        with suppress(InputError):  # files are gone, of which the run itself tells
            newer = changed_auto_choices(stage, config, record, stage.inputs(source, config) if stage.inputs else None)
            if networks := networks_chosen(newer):
                added[stage.name] = networks
    return _about_networks(run, added, {name: r.seconds for name, r in records.items()}) if added else ""


def _about_networks(run: RunFolder, added: dict[str, tuple[str, ...]], seconds: dict[str, float]) -> str:
    """Name the networks that stages could use by now, and the command, with the minutes that these stages took."""
    first = min(added, key=STAGES.index)
    minutes = sum(taken for name, taken in seconds.items() if STAGES.index(name) >= STAGES.index(first)) / 60
    return (
        f"Networks installed since this run: {', '.join(dict.fromkeys(n for v in added.values() for n in v))}. To use "
        f"them: msgs-slam resume {quoted(run.root)} --redo {first} (it took {minutes:.0f} min without them)"
    )


def expected_mb(stage: str, run: RunFolder, config: Config) -> float | None:
    """MB that a stage will need about, or has needed, by the keyframes that `frames` has found. A map in submaps needs
    that of one submap at a time."""
    try:
        camera, found = run.load(CALIBRATION).intrinsics, load_records(run)["frames"].figures
    except InputError:  # damaged, which is reported elsewhere
        return None
    keyframes, small = int(found.get("keyframes", found["frames"])), camera.at_most(config.mapping.max_side)
    parts = submap_count(keyframes, submap_size(config, camera))
    of_part = min(GAUSSIANS * keyframes / parts * small.width * small.height / 1e6, config.mapping.max_gaussians)
    least, a_million_pixels, a_keyframe, a_million_gaussians = NEEDS[stage]
    gaussians = of_part * (1 if stage == "mapping" else parts) / 1e6
    side = max(config.proxy.max_side, config.proxy.stereo_side)  # the largest that `proxy` has in work
    worked_on = camera.at_most(side) if stage == "proxy" else camera
    pixels = worked_on.width * worked_on.height / 1e6
    window = windows_of(keyframes, window_size(config.run.memory_mb, camera.width * camera.height))[0]
    at_once = {"frames": len(window), "tracking": ALIGNED_TOGETHER}
    inside = min(keyframes, at_once.get(stage, keyframes))
    by_keyframes = a_keyframe * inside + _BEYOND * (keyframes - inside)
    return round(least + a_million_pixels * pixels + by_keyframes + a_million_gaussians * gaussians)


def _state(run: RunFolder, name: str, record: StageRecord | None, damaged: tuple[str, ...]) -> str:
    if record is not None:
        return DAMAGED if damaged else DONE
    if run.partial(name).exists():
        return INTERRUPTED
    return OUTDATED if run.stage(name).exists() else NOT_YET
