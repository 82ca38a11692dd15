#!/usr/bin/env bash
# What the program does on this machine's NVIDIA card beside its CPU, in at most nine minutes:
#     tests/benchmarks/card.sh OUT [--video VIDEO] [--truth DATASET] [--only PART ...]
# OUT/card.json and OUT/card.md are written as figures come. See card.py.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
export PYTHONUNBUFFERED=1 OMP_WAIT_POLICY=${OMP_WAIT_POLICY:-passive}
exec "${PYTHON:-python3}" "$here/card.py" "$@"
