"""The evaluation as a table in Markdown."""

from __future__ import annotations

from typing import Any

from ..system.wording import markdown_table

Row = tuple[str, str, str]
TABLE_HEADER: Row = ("what", "value", "of")


def evaluation_table(result: dict[str, Any]) -> str:
    """The protocol, then one row a figure; an empty cell says why."""
    lines = [f"# {result['run']} against {result['truth']}", ""]
    lines += [f"- {line}" for line in result["protocol"]]
    lines += ["", *markdown_table(TABLE_HEADER, evaluation_rows(result))]
    return "\n".join(lines) + "\n"


def evaluation_rows(result: dict[str, Any]) -> list[Row]:
    """The cells under `TABLE_HEADER`."""
    stage = result["stage"]
    frames = result["frames"]
    of = f"{frames['picked']} picked, {frames['keyframes']} keyframes, {frames['with true pose']} with a true pose"
    if frames.get("by rotation alone"):
        of += f"; {frames['by rotation alone']} by rotation alone, which no error of a place counts"
    rows = [("frames posed", str(frames["posed"]), of), _camera_row(result["camera"])]
    rows += _trajectory_rows(result["trajectory"], stage["poses"])
    rows += _scale_rows(result["scale"])
    rows += _image_rows(result["images"], stage["map"])
    rows += _depth_rows(result["depth"]) + _label_rows(result["labels"]) + _mesh_rows(result["mesh"])
    return rows + _cost_rows(result["cost"])


def _missing(name: str, group: dict[str, Any]) -> list[Row]:
    return [(name, "–", group["missing"])]


def _camera_row(camera: dict[str, Any]) -> Row:
    if "missing" in camera:
        return ("focal length", f"{camera['fx']:.1f} px", f"{camera['origin']}; {camera['missing']}")
    return ("focal length", f"{camera['fx']:.1f} px ({camera['focal error']:+.2%})", camera["origin"])


def _trajectory_rows(cells: dict[str, Any], stage: str) -> list[Row]:
    if "missing" in cells:
        return _missing("trajectory", cells)
    rows = []
    for key, name in (("sim3", "ATE Sim(3)"), ("se3", "ATE SE(3)")):
        for frames in ("all", "keyframes"):
            cell = cells[f"{key} {frames}"]
            if "missing" in cell:
                rows += _missing(f"{name}, {frames}", cell)
                continue
            text = " / ".join(f"{100 * cell[k]:.2f}" for k in ("rmse", "mean", "median", "max")) + " cm"
            scale = f", scale {cell['scale']:.4f}" if key == "sim3" else ""
            rows.append((f"{name}, {frames}: rmse / mean / median / max", text, f"{cell['frames']} frames{scale}"))
    rpe = cells["rpe"]
    text = f"{100 * rpe['translation rmse']:.2f} cm, {rpe['rotation rmse degrees']:.3f}°"
    return [*rows, ("RPE rmse", text, f"{rpe['pairs']} pairs, poses of {stage}")]


def _scale_rows(cells: dict[str, Any]) -> list[Row]:
    if "missing" in cells:
        return _missing("metres per unit", cells)
    text = f"{cells['stated']:.4g} ± {cells['relative sd']:.1%}{', estimated' if cells['guess'] else ''}"
    return [("metres per unit", text, f"true {cells['true']:.4g}, {cells['sigmas']:.1f} sigmas off")]


def _image_rows(cells: dict[str, Any], stage: str) -> list[Row]:
    if "missing" in cells:
        return _missing("PSNR, SSIM", cells)
    rows: list[Row] = []
    for kind, cell in cells.items():
        if "missing" in cell:
            rows += _missing(f"PSNR, SSIM {kind}", cell)
            continue
        text = f"{_text(cell['psnr'], '.2f')} dB, {cell['ssim']:.4f}"
        rows.append((f"PSNR, SSIM {kind}", text, f"{cell['views']} views, map of {stage}"))
    lpips = {kind: cell["lpips"] for kind, cell in cells.items() if "lpips" in cell}
    known = [f"{kind} {value:.4f}" for kind, value in lpips.items() if isinstance(value, float)]
    if known:
        return [*rows, ("LPIPS", ", ".join(known), "AlexNet")]
    return rows + [row for value in list(lpips.values())[:1] for row in _missing("LPIPS", value)]


def _depth_rows(cells: dict[str, Any]) -> list[Row]:
    if "missing" in cells:
        return _missing("depth L1", cells)
    of = f"{cells['valid_fraction']:.1%} of the pixels with truth"
    metric = cells["metric_l1"]
    first = _missing("depth L1, metric", metric) if isinstance(metric, dict) else []
    first = first or [("depth L1, metric", f"{100 * metric:.2f} cm", of)]
    return [
        *first,
        ("depth L1, after one scale", f"{100 * cells['scaled_l1']:.2f} cm", f"{of}, × {cells['scale']:.4f}"),
    ]


def _label_rows(cells: dict[str, Any]) -> list[Row]:
    if "clustering" in cells:
        rows = _missing("mIoU, pixel accuracy", cells)
        for name, cell in cells["clustering"].items():
            text = f"{cell['mean_iou']:.2%}, {cell['pixel_accuracy']:.2%}"
            rows.append((f"as a clustering, {name} (classes named by the truth)", text, cells["input"]))
        return rows
    if "missing" in cells:
        return _missing("mIoU, pixel accuracy", cells)
    of = f"{cells['input']}, {cells['matching']}; over {len(cells['class_iou'])} classes of the truth"
    classes = ", ".join(f"{n} {v:.1%}" for n, v in sorted(cells["class_iou"].items(), key=lambda item: -item[1]))
    return [
        ("mIoU, pixel accuracy", f"{cells['mean_iou']:.2%}, {cells['pixel_accuracy']:.2%}", of),
        ("IoU of each class", classes, f"{cells['unlabelled']:.1%} of the pixels were given none of them"),
    ]


def _mesh_rows(cells: dict[str, Any]) -> list[Row]:
    if "missing" in cells:
        return _missing("mesh", cells)
    text = f"{100 * cells['accuracy']:.2f} cm, {100 * cells['completeness']:.2f} cm, {cells['f_score']:.1%}"
    return [("mesh accuracy, completeness, F-score", text, f"F-score at {100 * cells['threshold']:.0f} cm")]


def _cost_rows(cells: dict[str, Any]) -> list[Row]:
    stages = ", ".join(f"{name} {s:.1f}" for name, s in cells["seconds"].items())
    return [
        ("time", f"{cells['total seconds']:.1f} s", f"{cells['frames per second']:.2f} frames/s; {stages}"),
        ("peak memory", f"{cells['peak memory MB']:.0f} MB", ""),
        ("map", f"{cells['gaussians']} Gaussians", f"{cells['map MB']:.1f} MB"),
    ]


def _text(value: Any, form: str = ".4f") -> str:
    return format(value, form) if isinstance(value, float) else ("–" if value is None else str(value))
