# SPDX-License-Identifier: MIT
"""``predicted.json`` of a run: every standard deviation that was said before the machine moved for it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

PREDICTED = "predicted.json"
SCHEMA = "pmsmtool.predicted/1"


def entry(before: str, relative_std: Mapping[str, float], **more: object) -> dict[str, Any]:
    """Return one prediction: before which experiment it was said, and relative standard deviations by key."""
    return {"before": before, "relative_std": dict(relative_std), **more}


def dump_predicted(entries: list[dict[str, Any]]) -> str:
    """Return the file's text."""
    return json.dumps({"schema": SCHEMA, "predictions": entries}, indent=1) + "\n"
