"""Inputs of the stage beside the run; imports nothing that computes."""

from pathlib import Path

from ...formats.gps import read_track
from ...formats.reading import file_sha256
from ..config import GPS_AUTO, GPS_OFF, Config
from ..networks.registry import metric_card
from ..networks.session import card_identity


def export_inputs(source: Path, config: Config) -> dict[str, str] | None:
    """The network that the guess is made with, and the track: other fixes under the same name make other files."""
    card = metric_card() if config.export.scale == "auto" else None
    metres = {} if card is None else {"metres": card_identity(card)}
    track = {"track": file_sha256(Path(config.export.gps))} if _has_track(config) else {}
    return metres | track or None


def check_export(source: Path, config: Config) -> None:
    """Raise InputError where the track that the user gives cannot be read."""
    if _has_track(config):
        read_track(Path(config.export.gps))


def _has_track(config: Config) -> bool:
    return config.export.gps not in (GPS_AUTO, GPS_OFF)
