# SPDX-License-Identifier: MIT
"""``predicted.json`` of a run: what was said before the machine moved; ``refused.json``: what was refused meanwhile."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from pmsmtool.errors import ConfigError, IdentificationError
from pmsmtool.run_directory import RunDirectory

PREDICTED = "predicted.json"
SCHEMA = "pmsmtool.predicted/1"


def entry(before: str, relative_std: Mapping[str, float], **more: object) -> dict[str, Any]:
    """Return one prediction: before which experiment it was said, and relative standard deviations by key."""
    return {"before": before, "relative_std": dict(relative_std), **more}


def dump_predicted(entries: list[dict[str, Any]]) -> str:
    """Return the file's text."""
    return json.dumps({"schema": SCHEMA, "predictions": entries}, indent=1) + "\n"


REFUSED = "refused.json"
"""Experiments that ended before their traces were whole, by the keys of ``evaluate.Evaluation.refused``."""


def dump_refused(refused: Mapping[str, IdentificationError]) -> str:
    """Return refusals as JSON."""
    facts = {
        name: {"reason": e.reason, "what": e.what.partition(": ")[2], "where": e.where, "likely": e.likely,
               "hint": e.hint}
        for name, e in refused.items()
    }  # fmt: skip
    return json.dumps(facts, indent=1) + "\n"


def refused_in(run: RunDirectory) -> dict[str, IdentificationError]:
    """Return the refusals of a run; raises ``ConfigError`` where their record is damaged."""
    path = run.path / REFUSED
    if not path.is_file():
        return {}
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
        return {name: IdentificationError(**error) for name, error in facts.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise ConfigError(
            f"the record of what was refused is damaged: {error}", where=str(path), hint="identify again"
        ) from error
