# SPDX-License-Identifier: MIT
"""A run as the XML that test systems of a production line read (JUnit): a case per criterion, the verdict first."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from xml.etree import ElementTree

from pmsmtool.plain_text import plain
from pmsmtool.report.verdict import RAN, UNAVAILABLE, Verdict, latest_of

SUITE = "pmsmtool"


OUTCOME = {"pass": "", "partial": "skipped", "fail": "failure"}
"""What a case of the verdict becomes: a partial run is not green."""


def junit_xml(record: Mapping[str, Any], found: Verdict) -> str:
    """Return the JUnit XML of a run.

    The first case is the verdict. Then come, for each stage, whether it ran, its criteria, and as skipped cases the
    quantities that it refused.

    Parameters
    ----------
    record : mapping
        Content of ``run.json``.
    found : Verdict
        Of the same run.
    """
    suite = ElementTree.Element("testsuite", name=SUITE, timestamp=str(record["started_utc"]).rstrip("Z"))
    drive = record.get("drive") or {}
    facts = {"simulated": found.simulated, "serial": drive.get("serial", ""), "node": drive.get("node", "")}
    properties = ElementTree.SubElement(suite, "properties")
    for name, value in facts.items():
        ElementTree.SubElement(properties, "property", name=name, value=plain(str(value)))
    _case(suite, "commissioning", "verdict", OUTCOME[found.kind], "\n".join((found.headline, *found.details)))
    for stage in latest_of(record.get("stages", ())):
        name, status = stage["name"], stage["status"]
        outcome = "" if status in RAN else "skipped" if status == UNAVAILABLE else "failure"
        ran = _case(suite, name, "ran", outcome, str(stage.get("note") or stage.get("summary") or status))
        ran.set("time", f"{stage['seconds']:.3f}")
        for criterion in stage.get("acceptance", ()):
            said = f"{criterion['measured']}, limit {criterion['limit']}"
            _case(suite, name, criterion["what"], "" if criterion["ok"] else "failure", said)
        for quantity, reason in (stage.get("refused") or {}).items():
            _case(suite, name, f"{quantity} given", "skipped", reason)
    for key, kind in (("tests", "testcase"), ("failures", "testcase/failure"), ("skipped", "testcase/skipped")):
        suite.set(key, str(len(suite.findall(kind))))
    ElementTree.indent(suite)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(suite, encoding="unicode")}\n'


def _case(suite: ElementTree.Element, stage: str, name: str, outcome: str, text: str) -> ElementTree.Element:
    case = ElementTree.SubElement(suite, "testcase", classname=f"{SUITE}.{stage}", name=plain(name))
    found = ElementTree.SubElement(case, outcome or "system-out")
    if outcome:
        found.set("message", plain(text.splitlines()[0] if text else ""))
    found.text = plain(text)
    return case
