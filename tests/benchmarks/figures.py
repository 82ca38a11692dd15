"""The figures of quality that pages state, from one file: figures.toml.

    python tests/benchmarks/figures.py

writes today's figures into the sentences and rows of tables that the file lists. A test says where a page differs from
the file, and where it states such a figure that is not from there.
"""

import argparse
import math
import re
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
KEPT = Path(__file__).with_suffix(".toml")
_DATE = r"\d+ [A-Z][a-z]+"
_VALUE = rf"(?:{_DATE}|[-+]?[\d.]*\d|[a-z]+)"
_WORDS = (
    "none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve",
    "thirteen",
)  # fmt: skip
OF_QUALITY = re.compile(r"\d[\d.]*\s+dB\b|\d[\d.]*\s*%\s+mIoU|\d[\d.]*\s+cm\s+RMSE|\d[\d.]*\s*σ")
"""Figures that stand on a page only where the file puts them."""


def stated() -> tuple[dict[str, Any], dict[str, list[str]]]:
    """The figures, those of all metres together with them, and page → its sentences with names in braces."""
    figures = tomllib.loads(KEPT.read_text(encoding="utf-8"))
    pages = figures.pop("pages")
    metres = [row["metres"] for row in figures.values() if "metres" in row] + list(figures.pop("metres").values())
    missed = sum(abs(math.log(ratio)) > 1.8 * sd / 100 for ratio, sd in metres)
    spread = [sd for _, sd in metres]
    return figures | {
        "least": min(spread), "most": max(spread), "rooms": _WORDS[len(metres)], "missed": _WORDS[missed],
    }, pages  # fmt: skip


def places(template: str) -> re.Pattern[str]:
    """Where a sentence stands, whatever its figures are and wherever its lines break; groups are what is between."""
    literal = re.split(r"\{[^}]*\}", template)
    return re.compile(f"({_VALUE})".join(r"\s+".join(map(re.escape, part.split(" "))) for part in literal))


def with_figures(text: str, templates: list[str], figures: dict[str, Any]) -> str:
    """The page with the figures of today. Raises ValueError where a sentence does not stand there once."""
    for template in templates:
        found = list(places(template).finditer(text))
        if len(found) != 1:
            raise ValueError(f"stands {len(found)} times: {template}")
        for group, field in reversed(list(enumerate(re.findall(r"\{[^}]*\}", template), 1))):
            first, end = found[0].span(group)
            text = text[:first] + field.format(**figures) + text[end:]
    return text


def others(text: str, templates: list[str]) -> list[str]:
    """Figures of quality that stand elsewhere than in these sentences."""
    for template in templates:
        text = places(template).sub("", text)
    return OF_QUALITY.findall(text)


def main() -> None:
    """Write the figures into the pages."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    figures, pages = stated()
    for name, templates in pages.items():
        page = ROOT / name
        page.write_text(with_figures(page.read_text(encoding="utf-8"), templates, figures), encoding="utf-8")


if __name__ == "__main__":
    main()
