"""What the site is given while it is built: the pages of all commands and settings, and equations as MathML, which
browsers draw without any script."""

from __future__ import annotations

import html
import re
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import click
from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

from msgs_slam.msgs_cli.main import main
from msgs_slam.pipelines.config import Config, allowed_values, config_to_dict, meaning_of

_MATHS = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)

_SHIM = "https://unpkg.com/iframe-worker/shim"
"""What the theme lets pages on the disk search with; ours is beside them, so that nothing is fetched."""

_COLUMNS = 78
"""As wide as the page."""

_ANY = {"bool": "true &#124; false", "str": "text"}
"""What a setting of that type may be where nothing else restricts it."""


def on_files(files: Files, config: Any) -> Files:
    """Adds commands.md and settings.md."""
    files.append(File.generated(config, "commands.md", content=commands_page()))
    files.append(File.generated(config, "settings.md", content=settings_page()))
    return files


def on_page_content(content: str, **_: Any) -> str:
    """Every equation of a page."""
    return _MATHS.sub(_mathml, content)


def on_post_page(output: str, **_: Any) -> str:
    """A page with the script that its search needs on the disk."""
    return output.replace(_SHIM, "disk_worker.js")


on_post_template = on_post_page
"""The page for addresses that are not there."""


def _mathml(found: re.Match[str]) -> str:
    return convert(html.unescape(found[2]), display="inline" if found[1] == "span" else "block")


def commands_page() -> str:
    """Markdown of what every command says of itself."""
    return "# Commands\n\nThis page is made from the program.\n" + "".join(_help_of(main, "msgs-slam", None))


def _help_of(command: click.Command, name: str, above: click.Context | None) -> Iterator[str]:
    options = {**main.context_settings, "max_content_width": _COLUMNS, "terminal_width": _COLUMNS}
    context = click.Context(command, info_name=name, parent=above, **options)
    yield f"\n## {context.command_path}\n\n```text\n{command.get_help(context)}\n```\n"
    if isinstance(command, click.Group):
        for below in command.list_commands(context):
            yield from _help_of(command.commands[below], below, context)


def settings_page() -> str:
    """Markdown of every setting: key, default, what it may be, meaning."""
    parts = [
        "# Settings\n\nThis page is made from the program. `msgs-slam config` prints the same as TOML; "
        "`--set SECTION.KEY=VALUE` changes one, `--config FILE` many. A run remembers its own."
    ]
    for section in fields(Config):
        values = getattr(Config(), section.name)
        parts.append(f"\n## {section.name}\n\n{type(values).__doc__}\n\n| key | default | may be | meaning |")
        parts.append("| --- | --- | --- | --- |")
        defaults = config_to_dict(values)
        for f in fields(values):
            may_be = allowed_values(f) or _ANY[f.type.__name__]
            cells = (f"`{f.name}`", f"`{defaults[f.name]!r}`", may_be, meaning_of(f))
            parts.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(parts) + "\n"
