# SPDX-License-Identifier: MIT
"""What is recorded of an identification without injection: each value judged for itself, as with injection.

What recorded torque pushes do not tell of some machines, although a number comes out: said by name, not given.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.estimators.resistance import at_the_test
from pmsmtool.identification.completed_machine import CompletedMachine
from pmsmtool.identification.interval_needs import JUDGED
from pmsmtool.identification.value_verdict import STANDS_FOR, judged_values, value_facts
from pmsmtool.identification.verdicts import NOT_ACCEPTED, STEP, Verdicts, verdicts_of
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import Estimate
from pmsmtool.run_directory import Acceptance, Stage
from pmsmtool.units import format_estimate

TOLD_BY: Mapping[str, tuple[str, ...]] = {
    "R": ("R_s_ohm",), "L": ("L_q_app_h",), "psi": ("psi_f_wb",), "encoder": ("offset_rad",), "poles": ("pole_pairs",),
    "mechanics": ("J_per_psi", "J_per_kt"),
}  # fmt: skip
"""Keys of the estimates of which one answers for a quantity."""
NOT_TOLD = "E_NOT_MEASURED"


@dataclass(frozen=True, slots=True)
class Judgement:
    """The criterion of each judged value by its key, and what became of each quantity that was asked for."""

    acceptance: Mapping[str, Acceptance]
    verdicts: Verdicts

    @property
    def rejected(self) -> set[str]:
        """Keys of values whose interval is too wide."""
        return {name for name, line in self.acceptance.items() if not line.ok}

    def kept(self, estimates: Mapping[str, Estimate]) -> dict[str, Estimate]:
        """Return the estimates that are accepted."""
        return without(estimates, self.rejected)


def judged(
    estimates: Mapping[str, Estimate], missing: Mapping[str, str], asked: Sequence[str], machine: MachineFile | None
) -> Judgement:
    """Judge every value by what its interval costs the design of a machine; what is missing is refused by its reason.

    Parameters
    ----------
    estimates : mapping of str to Estimate
        By their keys.
    missing : mapping of str to str
        Keys, separated by commas, and why they cannot be told.
    asked : sequence of str
        Quantities; those that no experiment of these drives tells are left out.
    machine : MachineFile, optional
        The machine with the estimates in it, where it is whole.
    """
    acceptance = judged_values(
        {name: estimate for name, estimate in at_the_test(estimates).items() if name in JUDGED or name in STANDS_FOR},
        machine,
    )
    had = [STEP[name] for name, told in TOLD_BY.items() if set(told) & set(estimates)]
    lacking = {
        STEP[name]: _refusal(why)
        for name, told in TOLD_BY.items()
        for keys, why in missing.items()
        if told[0] in keys.split(", ") and not set(told) & set(estimates)
    }
    return Judgement(acceptance, verdicts_of([name for name in asked if name in TOLD_BY], lacking, had, acceptance))


def _refusal(why: str) -> IdentificationError:
    """Return the error of a quantity that is missing; a reason that has its name keeps it."""
    name, _, text = why.partition(": ")
    reason, what = (name, text) if name.startswith("E_") else (NOT_TOLD, why)
    return IdentificationError(reason, what, hint="state it in MACHINE, or allow more current and speed")


def stage_of(
    estimates: Mapping[str, Estimate],
    missing: Mapping[str, str],
    made: CompletedMachine,
    judgement: Judgement,
    source: str,
) -> Stage:
    """Return the stage as it is recorded, without its files."""
    verdicts, rejected = judgement.verdicts, judgement.rejected
    values = [{**value_facts(name, estimate), "accepted": name not in rejected} for name, estimate in estimates.items()]
    summary = ", ".join(
        f"{name} {format_estimate(e.value, total_half_width(e), e.unit)}"
        for name, e in estimates.items()
        if name not in rejected
    )
    said = {key for name in verdicts.refused for key in TOLD_BY[name]}
    lost = [f"{name} not identified: {why}" for name, why in missing.items() if said & set(name.split(", "))]
    unsaid = {name: why for name, why in missing.items() if not said & set(name.split(", "))}
    refused = [f"{name} refused" for name, why in verdicts.refused.items() if why.startswith(NOT_ACCEPTED)]
    fallen = [f"{name}: {estimate.fallback}" for name, estimate in estimates.items() if estimate.fallback]
    given = [f"{source}: {', '.join(made.given)}"] if made.given else []
    return Stage(
        "identify",
        verdicts.status,
        0.0,
        values=[*values, *made.given_values(source)],
        # what is refused is no criterion of the values that go on
        acceptance=[line for line in judgement.acceptance.values() if line.ok or verdicts.status == "fail"],
        fallbacks=[
            *verdicts.lines(),
            *(f"{name}: not available: {why}" for name, why in unsaid.items()),
            *fallen,
            *made.notes,
        ],
        note="" if made.machine is not None else "a part of the machine only: no machine file is written",
        summary="; ".join(filter(None, (summary, *lost, *refused, *given))),
        refused=dict(verdicts.refused),
    )


def without(estimates: Mapping[str, Estimate], reasons: Iterable[str]) -> dict[str, Estimate]:
    """Return the estimates that are given; the friction goes with the inertia it was told with."""
    left_out = set(reasons)
    left_out |= {"tau_c_per_psi"} if "J_per_psi" in left_out else set()
    return {name: estimate for name, estimate in estimates.items() if name not in left_out}
