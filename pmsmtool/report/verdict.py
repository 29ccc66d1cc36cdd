# SPDX-License-Identifier: MIT
"""The first thing a reader sees of a run: whether all that was asked for ran and held its criteria, and on which drive.

A run passes only when every stage it must have ran and passed, and nothing its result follows from stayed unchecked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal
from xml.etree import ElementTree

from pmsmtool.errors import ExitCode
from pmsmtool.plain_text import by_reason, plain
from pmsmtool.report.comparison import headline, not_checked, unchecked

COMPLETE = ("identify", "tune", "margins", "lut", "flash", "verify", "prove")
"""Stages of a full commissioning."""

VENDOR = "vendor"
"""Source of a value that the drive measured by itself: without an interval."""

AS_GIVEN = "as given"
"""Source of a value that a person brought in a machine file."""

UNAVAILABLE = "not available"
"""Status of a stage that the drive cannot give."""

RAN = ("pass", "partial")
"""Status of a stage that ran and met its criteria; ``partial``: something asked of it could not be had."""

NEEDED = ("pole_pairs", "R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb", "J_kgm2")
"""Values that the gains of a commissioning follow from."""

RATIOS = {"J_kgm2": "J_per_psi"}
"""Needed values that a drive without a voltage gives as a ratio to the flux linkage."""

ENCODER_SIGN = "encoder sign"
"""Key of a stage's refusals where the position falls under positive torque."""

SIMULATED = "SIMULATED DRIVE"
SIMULATED_INTERFACE = "pmsmsim"
SIMULATED_NAMES = ("pmsmsim", "simulated ")
"""How the device names (0x1008) of this program's simulated drives begin, on every bus that serves them."""

STOP_NOT_CONFIRMED = "STOP NOT CONFIRMED"
USE_HARDWARE_STOP = "the machine may be energised: use the hardware stop"

SUITE = "pmsmtool"


OUTCOME = {"pass": "", "partial": "skipped", "fail": "failure"}
"""What a case of the verdict becomes: a partial run is not green."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a run is worth."""

    kind: Literal["pass", "partial", "fail"]
    """``pass``, ``partial`` or ``fail``."""
    word: str
    """``PASS``, ``PARTIAL``, ``FAIL`` or ``STOP NOT CONFIRMED``."""
    lines: tuple[str, ...]
    """Its reasons; the first one completes the headline."""
    simulated: bool = False
    """Whether a simulated drive answered, as far as its identity says so."""

    @property
    def headline(self) -> str:
        """The verdict in one line: whose drive, the word, its first reason."""
        return f"{f'{SIMULATED}, ' if self.simulated else ''}{self.word}: {self.lines[0]}"

    @property
    def details(self) -> tuple[str, ...]:
        """The reasons below the headline."""
        return self.lines[1:]


def is_simulated(record: Mapping[str, Any]) -> bool:
    """Return whether a run was made on a simulated drive of this program: its bus, or the name it gives itself."""
    name = str(record.get("drive", {}).get("name") or "")
    return record.get("bus", {}).get("interface") == SIMULATED_INTERFACE or name.startswith(SIMULATED_NAMES)


def on_which_drive(text: str, record: Mapping[str, Any]) -> str:
    """Return a headline that says so where a simulated drive answered."""
    return ", ".join(part for part in (SIMULATED if is_simulated(record) else "", text) if part)


def latest_of(stages: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the last entry of every stage, in the order the stages were first run."""
    return list({stage["name"]: stage for stage in stages}.values())


def comparison_of(latest: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the rows *data sheet | drive | measured* of a run."""
    return [row for stage in latest for row in stage.get("comparison", ())]


def verdict_of(record: Mapping[str, Any], complete: Sequence[str] = COMPLETE) -> Verdict:
    """Return the verdict on a run; the last entry of each stage counts.

    Parameters
    ----------
    record : mapping
        Content of ``run.json`` (schema ``pmsmtool.run/1``).
    complete : sequence of str
        Stages that a pass needs.
    """
    latest = latest_of(record.get("stages", ()))
    account = record.get("account") or {}
    ended = account.get("exit_code") if account.get("state", "complete") != "complete" else None
    simulated = is_simulated(record)
    accepted, unmeasured = headline(comparison_of(latest))
    accepted += [str(line) for stage in latest for line in stage.get("accepted", ())]
    failures = [*_failures(latest, stopped=ended in _NOT_JUDGED), *_required(record, latest)]
    if ended == ExitCode.STOP_NOT_CONFIRMED:
        return Verdict("fail", STOP_NOT_CONFIRMED, (USE_HARDWARE_STOP, *failures, *accepted), simulated)
    if failures:
        ran = [stage for stage in latest if stage["status"] in RAN]
        return Verdict("fail", "FAIL", (*failures, *unmeasured, *accepted, *_refused(ran)), simulated)
    ran = [stage for stage in latest if stage["status"] in RAN]
    left = [*unmeasured, *_unchecked(latest, complete)]
    missing = [*_missing(latest, complete), *_unfinished(account, latest)]
    head = "; ".join((*_interrupted(latest, complete), _counted(ran, latest, complete)))
    partial = bool(missing or left or not ran) or any(stage["status"] in _PARTLY for stage in latest)
    if not partial:
        return Verdict("pass", "PASS", (head, *_shown(latest, complete), *accepted), simulated)
    return Verdict("partial", "PARTIAL", ("; ".join((*_wrong(latest), head, *left)), *accepted, *missing), simulated)


_PARTLY = ("partial", "interrupted")
_NOT_JUDGED = (ExitCode.DECLINED, ExitCode.INTERRUPTED)
"""Exit codes of a run that a person ended: no criterion was broken."""


def _failures(latest: Sequence[Mapping[str, Any]], *, stopped: bool) -> list[str]:
    """Return what failed, one line per stage; a stage that a person ended did not."""
    ended = ("refused", "interrupted") if stopped else ()
    failed = [stage for stage in latest if stage["status"] not in (*RAN, UNAVAILABLE, *ended)]
    return [f"{_with_status(stage)}: {_failure(stage)}" for stage in failed]


def _interrupted(latest: Sequence[Mapping[str, Any]], complete: Sequence[str]) -> list[str]:
    """Return where a person ended the run, and how the drive was left: what he wants to know first."""
    again = "; resumed, it begins with that stage again" if len(complete) > 1 else ""
    return [
        f"interrupted during {stage['name']}: {stage['note']}{again}"
        for stage in latest
        if stage["status"] == "interrupted"
    ]


def _wrong(latest: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the wiring that was seen to be wrong: to be read before what ran, for no loop may be closed over it."""
    found = ((stage.get("refused") or {}).get(ENCODER_SIGN) for stage in latest)
    return [f"{ENCODER_SIGN} WRONG: {str(why).split(' (likely', 1)[0]}" for why in found if why]


def _required(record: Mapping[str, Any], latest: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the stages that were required (``--require``) and did not run."""
    found = {stage["name"]: stage for stage in latest}
    lines = []
    for name in (record.get("request") or {}).get("require", ()):
        stage = found.get(name)
        if stage is None:
            lines.append(f"{name}: required, and it did not run")
        elif stage["status"] == UNAVAILABLE:
            lines.append(f"{name}: required, and not available: {stage['note']}")
    return lines


def _unchecked(latest: Sequence[Mapping[str, Any]], complete: Sequence[str]) -> list[str]:
    """Return what else the result follows from and nothing measured: not in the comparison, or not compared."""
    told = set(unchecked(comparison_of(latest)))
    compared = {str(row["name"]) for row in comparison_of(latest) if row.get("stated") is not None}
    values = [value for stage in latest for value in stage.get("values", ()) if value["name"] not in told]
    bare: dict[str, list[str]] = {}
    for value in values:
        if "source" in value and "std" not in value and not (value["source"] == AS_GIVEN and value["name"] in compared):
            bare.setdefault(str(value["source"]), []).append(str(value["name"]))
    sources = {VENDOR: "the drive's own measurement, without an interval", AS_GIVEN: "data sheet"}
    lines = [not_checked(names, sources.get(source, source)) for source, names in bare.items()]
    identified = next((stage for stage in latest if stage["name"] == "identify" and stage["status"] in RAN), None)
    if len(complete) > 1 and identified is not None:
        known = {str(value["name"]) for value in values if "std" in value or "source" in value} | told
        absent = [name for name in NEEDED if name not in known and RATIOS.get(name) not in known]
        lines += [not_checked(absent, "not measured in this run")] if absent else []
    if len(complete) > 1:
        lines += [str(line) for stage in latest for line in stage.get("not_checked", ())]
    return list(dict.fromkeys(lines))


def _missing(latest: Sequence[Mapping[str, Any]], complete: Sequence[str]) -> list[str]:
    """Return which stages did not run, or not wholly, each with its reason."""
    found = {stage["name"] for stage in latest}
    odd = [stage for stage in latest if stage["status"] not in ("pass", "interrupted") and not stage.get("refused")]
    how = ("" if stage["status"] == "fail" else f": {stage['status']}" for stage in odd)
    ended = [f"{end}: {str(stage['note']) or _failure(stage)}" for stage, end in zip(odd, how, strict=True)]
    lines = by_reason(((str(stage["name"]), why) for stage, why in zip(odd, ended, strict=True)), "")
    lines += _refused(latest)
    never = [name for name in complete if name not in found and len(complete) > 1]
    return [*lines, *([f"not run: {', '.join(never)}"] if never else [])]


def _refused(stages: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what was asked for and refused, each with its reason."""
    return by_reason((reason for stage in stages for reason in (stage.get("refused") or {}).items()), ": refused: ")


def _unfinished(account: Mapping[str, Any], latest: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return that a run did not come to its end, where no stage says so: it was killed, or could not be written."""
    said = any(stage["name"] == account.get("stage") and stage["status"] != "pass" for stage in latest)
    if said or account.get("state", "complete") == "complete":
        return []
    return [f"{account['stage']}: begun, and its end was not recorded"]


def _shown(latest: Sequence[Mapping[str, Any]], complete: Sequence[str]) -> list[str]:
    """Return what a pass does not show: the experiments that its proof left out, and notes of a run of one stage."""
    proof = next((stage for stage in latest if stage["name"] == "prove"), None)
    lines = [] if proof is None else [f"prove: {line}" for line in proof.get("fallbacks", ())]
    if len(complete) == 1:
        lines += [str(line) for stage in latest for line in stage.get("not_checked", ())]
    return lines


def _counted(ran: Sequence[Mapping[str, Any]], latest: Sequence[Mapping[str, Any]], complete: Sequence[str]) -> str:
    """Return how much ran and was judged."""
    criteria = sum(len(stage.get("acceptance", ())) for stage in ran)
    met = {0: "no criteria", 1: "1 criterion, met"}.get(criteria, f"{criteria} criteria, all met")
    if len(complete) == 1:
        names = " and ".join(str(stage["name"]) for stage in latest)
        return f"{names}{' alone' if len(latest) == 1 else ''}, {met}" if names else f"{complete[0]} did not run"
    count = sum(stage["name"] in complete for stage in ran)
    if not count:
        return "no stage came to its end"
    proven = "" if any(stage["name"] == "prove" for stage in ran) else ", behaviour not proven"
    return f"{count} of {len(complete)} stages ran, {met}{proven}"


def _with_status(stage: Mapping[str, Any]) -> str:
    """Return the name of a stage, with how it ended where that says more than that it failed."""
    return str(stage["name"]) if stage["status"] == "fail" else f"{stage['name']}: {stage['status']}"


def _failure(stage: Mapping[str, Any]) -> str:
    broken = [line for line in stage.get("acceptance", ()) if not line["ok"]]
    if broken:
        return "; ".join(f"{line['what']}: {line['measured']}, limit {line['limit']}" for line in broken)
    return str(stage.get("note") or stage["status"])


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
