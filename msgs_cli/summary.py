"""The last words of a command that has brought a run to its end: table, warnings, where the results are."""

from pathlib import Path
from typing import Any

from .output import Output, is_said
from .text import say


def tell_run(output: Output, root: Path, records: dict[str, Any]) -> None:
    """Say how the run is now, for people unless they want errors only, and for programs."""
    if not output.quiet:
        print_summary(root, records)
    output.tell_result(run=root, **({"export": root / "export"} if "export" in records else {}))


def print_summary(root: Path, records: dict[str, Any]) -> None:
    """Print the table, what is not said yet, and where the results are."""
    from ..pipelines.reconstruct import all_stages
    from ..pipelines.run.folder import RunFolder
    from ..pipelines.status import DONE, StageStatus, about_new_networks
    from .tables import scale_lines, status_table, warning_lines

    say(status_table([StageStatus(name, DONE, record) for name, record in records.items()]))
    for line in warning_lines(records, is_said):
        say(line, err=True)
    for line in scale_lines(root, records):
        say(line)
    if line := about_new_networks(RunFolder(root), all_stages()):
        say(f"\n{line}")
    if "export" in records:
        say(f"\nResults: {root / 'export'} (README.txt there says what each file is for)")
