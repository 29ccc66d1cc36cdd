# SPDX-License-Identifier: MIT
"""What was refused while it was measured, in the run: a replay is to give the same reasons."""

from __future__ import annotations

import json
from collections.abc import Mapping

from pmsmtool.errors import ConfigError, IdentificationError
from pmsmtool.run_directory import RunDirectory

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
