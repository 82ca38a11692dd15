"""What the site is given while it is built: the page of all settings, and equations as MathML, which browsers draw
without any script."""

from __future__ import annotations

import html
import re
from dataclasses import fields
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

from pipelines.config import Config, allowed_values, config_to_dict

_MATHS = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_files(files: Files, config: Any) -> Files:
    """Adds settings.md."""
    files.append(File.generated(config, "settings.md", content=settings_page()))
    return files


def on_page_content(content: str, **_: Any) -> str:
    """Every equation of a page."""
    return _MATHS.sub(_mathml, content)


def _mathml(found: re.Match[str]) -> str:
    return convert(html.unescape(found[2]), display="inline" if found[1] == "span" else "block")


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
            cells = (f"`{f.name}`", f"`{defaults[f.name]!r}`", allowed_values(f), f.metadata["help"])
            parts.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(parts) + "\n"
