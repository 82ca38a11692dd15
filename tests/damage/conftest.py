"""The good files come from helpers of other tests."""

import sys
from pathlib import Path

PIPELINES = Path(__file__).resolve().parents[1] / "pipelines"
sys.path[:0] = [str(PIPELINES), str(PIPELINES / "proxy")]
