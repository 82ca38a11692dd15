"""The synthetic room as a run folder and as views, as mapping has it."""

from tests.pipelines.mapping.conftest import room, small_run

__all__ = ["room", "small_run"]
