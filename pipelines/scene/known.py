"""The scale where the run is metric already: by a reference, by depth files, or by a metric network."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .evidence import Evidence, Mode
from .network import LARGE_SD

_SENSOR_SD = 0.02
"""Depth cameras: 1 to 3 % at room distances after the factory's calibration (Khoshelham and Oude Elberink, Sensors
2012, for the Kinect)."""
_SENSOR_SPREAD = 0.02
"""Depth that strays more than this from the triangulated points, relatively, is no sensor's."""
_LEAST_SD = 0.003
MEASURED = "measured"
"""Kind of what somebody has measured: a length that the user knows, a depth camera."""


def known_scale(report: Mapping[str, Any], spreads: list[float], statistical_sd: float) -> list[Evidence]:
    """Return evidence that the unit is a metre, from whatever made the world metric; none for a run without metres.

    report: the proxy stage's; spreads: relative spread of each frame's depth around its triangulated points;
    statistical_sd: relative deviation of the scale that tracking fitted to the depth.
    """
    if not report.get("metric"):
        return []
    if report.get("scale_from") == "reference":
        sd = max(float(report["reference_relative_sd"]), _LEAST_SD)
        return [Evidence("the given reference", MEASURED, (Mode(0.0, sd),), 0.0, is_guess=False)]
    name = str(report.get("depth", "depth"))
    is_sensor = name.startswith("files") and (not spreads or float(np.median(spreads)) < _SENSOR_SPREAD)
    sd = float(np.hypot(_SENSOR_SD if is_sensor else LARGE_SD, statistical_sd))
    kind = MEASURED if is_sensor else "network"
    return [Evidence(f"the depth of {name}", kind, (Mode(0.0, sd),), 0.0 if is_sensor else 0.03, is_guess=False)]
