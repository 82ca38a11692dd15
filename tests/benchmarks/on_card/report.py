"""The rows of `card.json` as tables of Markdown."""

from typing import Any

Row = dict[str, Any]


def markdown(rows: dict[str, list[Row]]) -> str:
    """All tables of which there are rows."""
    parts = [
        _machine(rows.get("machine", [])),
        _tests(rows.get("tests", [])),
        _errors(rows.get("errors", [])),
        _timings(rows.get("timings", [])),
        _launches(rows.get("launches", [])),
        _kernels(rows.get("kernels", [])),
        _gsplat(rows.get("gsplat", [])),
        _job(rows.get("job", [])),
        _failures(rows.get("failures", [])),
        _table(("part", "exit code", "s", "limit"), [
            (r["part"], r["exit_code"], r["seconds"], r["limit"]) for r in rows.get("parts", [])
        ]),
    ]  # fmt: skip
    return "\n".join(p for p in parts if p)


def _table(head: tuple[str, ...], lines: list[tuple[Any, ...]]) -> str:
    if not lines:
        return ""
    whole = [head, ("---",) * len(head), *lines]
    return "".join("| " + " | ".join(_cell(c) for c in line) + " |\n" for line in whole)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.2e}" if 0 < abs(value) < 1e-2 else f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"
    return "–" if value is None else str(value)


def _machine(found: list[Row]) -> str:
    return "".join(", ".join(f"{k} {v}" for k, v in r.items()) + "\n" for r in found)


def _tests(found: list[Row]) -> str:
    return "".join(
        f"Tests of the kernels: {r['passed']} passed, {len(r['failed'])} failed, {r['seconds']} s, exit code "
        f"{r['exit_code']}\n" + "".join(f"- failed: {name}\n" for name in r["failed"])
        + "".join(f"    {line[:160]}\n" for line in r["said"][:12])
        for r in found
    )  # fmt: skip


def _errors(found: list[Row]) -> str:
    lines = [(r["case"], r["of"], r["relative"], r["largest"], f"{r['far']:.2%}", "" if r["agrees"] else "**no**")
             for r in found]  # fmt: skip
    return _table(("errors", "of", "relative", "largest / max", "far", "agrees"), lines)


def _timings(found: list[Row]) -> str:
    by: dict[tuple[str, str], dict[str, Row]] = {}
    for r in found:
        by.setdefault((r["case"], r["of"]), {})[r["place"]] = r
    lines = []
    for (case, of), places in by.items():
        card, cpu = (places.get(p, {}).get("ms") for p in ("card", "cpu"))
        ratio = cpu / card if card and cpu else None
        lines.append((case, of, card, cpu, ratio, places.get("card", {}).get("first")))
    return _table(("times", "of", "card, ms", "CPU, ms", "ratio", "card's first, s"), lines)


def _launches(found: list[Row]) -> str:
    """Launches by the profiler, in which a sort of torch counts all its kernels, beside those of `launches.py`."""
    lines = [
        (r["of"], f"{r['kernels']} + {r['fills']} fills + {r['copies to'] + r['copies from']} copies",
         r["expected"].get("launches"), r["copies from"], r["waits"], r["expected"].get("reads"), r["bytes to"],
         r["bytes from"], r["busy_us"])
        for r in found
    ]  # fmt: skip
    head = (
        "work",
        "launches",
        "counted",
        "copies from",
        "waits",
        "reads counted",
        "bytes to",
        "bytes from",
        "busy, µs",
    )
    return _table(head, lines)


def _kernels(found: list[Row]) -> str:
    wanted = [r for r in found if r["of"] in ("a visit", "stereo of a keyframe")]
    return _table(("kernels of", "kernel", "count", "µs"), [
        (r["of"], f"`{r['kernel'][:44]}`", r["count"], r["microseconds"]) for r in wanted
    ])  # fmt: skip


def _gsplat(found: list[Row]) -> str:
    lines = [(r.get("case"), r["of"], r.get("forward_ms"), r.get("both_ms"), r.get("peak_mb"), r.get("mean_difference"))
             for r in found]  # fmt: skip
    return _table(("beside gsplat", "by", "forward, ms", "with gradients, ms", "MB", "mean difference"), lines)


def _job(found: list[Row]) -> str:
    stages = list(dict.fromkeys(s for r in found for s in r["stages"]))
    skipped = {"place", "stages", "said"}
    others = list(dict.fromkeys(k for r in found for k in r if k not in skipped))
    lines = [(r["place"], *(r["stages"].get(s) for s in stages), *(r.get(k) for k in others)) for r in found]
    said = "".join(f"{r['place']}: {r['said']}\n" for r in found if "said" in r)
    return _table(("whole job, s", *stages, *others), lines) + said


def _failures(found: list[Row]) -> str:
    return "".join(f"FAILED {r['case']}: {r['error'][-500:]}\n" for r in found)
