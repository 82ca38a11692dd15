"""The ablations as a table in Markdown."""

from __future__ import annotations

from typing import Any


def ablation_table(result: dict[str, Any]) -> str:
    """The protocol, a row a variant, then what could not be measured and what each row switches."""
    rows = result["rows"]
    columns = list(dict.fromkeys(c for row in rows for c in row["mean"]))
    lines = [f"# Ablations of {result['source']} against {result['truth']}", ""]
    lines += [f"- {note}" for note in result["notes"]]
    lines += ["", "| | " + " | ".join(["seeds", *columns]) + " |", "| --- " * (len(columns) + 2) + "|"]
    for row in rows:
        cells = [_cell(row, column) for column in columns]
        lines.append(f"| {row['name']} | {', '.join(map(str, row['seeds']))} | " + " | ".join(cells) + " |")
    lines += ["", *(f"- {c}: – ({why})" for c, why in result["missing"].items() if c not in columns)]
    lines += [f"- {row['name']}: {', '.join(row['settings']) or 'all terms'}" for row in rows]
    return "\n".join(lines) + "\n"


def _cell(row: dict[str, Any], column: str) -> str:
    if column not in row["mean"]:
        return "–"
    mean, sd = row["mean"][column], row["sd"].get(column)
    digits = 0 if column == "Gaussians" else 4 if column in ("SSIM", "LPIPS") else 2
    return f"{mean:.{digits}f}" + ("" if sd is None else f" ± {sd:.{digits}f}")
