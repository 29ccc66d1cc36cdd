# SPDX-License-Identifier: MIT
"""The one place where a quantity is accepted or refused: each for itself, whatever became of the others.

A quantity that was asked for is accepted when its experiment ran, its estimator gave a value and the interval of the
value is good enough; else it is refused with its reason, and what follows from that is said.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from pmsmtool.errors import IdentificationError
from pmsmtool.run_directory import Acceptance, Status

STEP: Mapping[str, str] = {
    "R": "R", "inverter": "R", "poles": "encoder", "encoder": "encoder", "L": "L", "psi": "psi",
    "mechanics": "mechanics", "map": "map", "frf": "frf", "cogging": "cogging", "harmonics": "harmonics",
}  # fmt: skip
"""Evaluation that answers for a quantity (``evaluate.Evaluation.refused``)."""
NEEDED: Mapping[str, tuple[str, ...]] = {
    "L": ("R", "encoder"), "psi": ("R", "encoder", "L"), "mechanics": ("psi",), "frf": ("psi",), "map": ("R", "psi"),
    "cogging": ("mechanics",), "harmonics": ("L", "psi"),
}  # fmt: skip
"""Evaluations that another one takes values from."""
KEYS: Mapping[str, tuple[str, ...]] = {
    "R": ("R_s_ohm",), "encoder": ("offset_rad",), "L": ("L_d_h", "L_q_h", "L_q_app_h"), "psi": ("psi_f_wb",),
    "mechanics": ("J_kgm2", "J_per_psi", "J_per_kt"), "map": ("flux map",),
}  # fmt: skip
"""Keys of the machine file (and the map) whose intervals are judged for a quantity."""
FOLLOWS: Mapping[str, str] = {
    "R": "a design goes on only with a machine file that states R",
    "inverter": "the voltage error of the inverter is not compensated",
    "L": "a design goes on only with a machine file that states L",
    "psi": "a design goes on only with a machine file that states psi",
    "encoder": "torque needs the encoder offset: nothing that turns the shaft goes on",
    "poles": "torque needs the pole pairs: nothing that turns the shaft goes on",
    "mechanics": "friction is not known; without J (mean acceleration, machine file) speed control is not designed",
    "map": "the design is made with constant inductances",
    "frf": "no resonance is known, and no notch is set",
    "cogging": "there is no table of its torque",
    "harmonics": "the torque's ripple by the back-EMF is not known",
}
"""What follows from a refused quantity."""
ESSENTIAL = ("poles", "encoder")
"""Quantities without which the chain does not go on, whatever a machine file says."""
DESIGNED_FROM = ("R", "L", "psi")
"""Quantities without which it goes on only with a machine file that a person gave."""
NOT_ACCEPTED = "E_NOT_ACCEPTED"
ENDED = "run"
"""Key beside the evaluations: why a run ended, for all that it did not reach."""


@dataclass(frozen=True, slots=True)
class Verdicts:
    """What became of each quantity that was asked for."""

    accepted: tuple[str, ...]
    """Quantities."""
    refused: Mapping[str, str]
    """Quantity -> reason: name and sentence."""

    @property
    def status(self) -> Status:
        """``pass``, ``partial`` or ``fail``."""
        return "pass" if not self.refused else "partial" if self.accepted else "fail"

    def lines(self) -> list[str]:
        """Return one line for every refused quantity, with what follows from it."""
        return [
            f"{name} refused: {reason}{f'; {FOLLOWS[name]}' if name in FOLLOWS else ''}"
            for name, reason in self.refused.items()
        ]


def verdicts_of(
    asked: Iterable[str],
    refused: Mapping[str, IdentificationError],
    had: Iterable[str],
    acceptance: Mapping[str, Acceptance],
) -> Verdicts:
    """Judge every quantity that was asked for.

    Parameters
    ----------
    asked : iterable of str
        Quantities, keys of :data:`STEP`.
    refused : mapping of str to IdentificationError
        By evaluation.
    had : iterable of str
        Evaluations that gave a result.
    acceptance : mapping of str to Acceptance
        Criterion of each judged key.
    """
    asked, had = tuple(asked), set(had)
    good: list[str] = []
    bad: dict[str, str] = {}
    for quantity in asked:
        step = STEP[quantity]
        broken = [acceptance[key] for key in KEYS.get(quantity, ()) if key in acceptance and not acceptance[key].ok]
        if step not in had:
            bad[quantity] = _why(step, refused, had, asked)
        elif broken:
            bad[quantity] = f"{NOT_ACCEPTED}: " + "; ".join(
                f"{line.what} {line.measured}, limit {line.limit}" for line in broken
            )
        else:
            good.append(quantity)
    return Verdicts(tuple(good), bad)


def _why(step: str, refused: Mapping[str, IdentificationError], had: set[str], asked: Sequence[str]) -> str:
    """Return why an evaluation gave no result: its own refusal, or the first one of what it needs."""
    root = step
    while root not in refused:
        lacking = next((name for name in NEEDED.get(root, ()) if name not in had), None)
        if lacking is None:
            break
        root = lacking
    needs = "" if root == step else f"needs {root}: "
    if root not in refused and ENDED not in refused:
        return f"{needs}not measured: the run ended before it"
    error = refused.get(root) or refused[ENDED]
    if needs and any(STEP[quantity] == root for quantity in asked):
        return needs + error.reason  # told in full where it was asked for
    more = "; ".join(f"{name}: {text}" for name, text in (("likely", error.likely), ("try", error.hint)) if text)
    return f"{needs}{error.what} ({more})" if more else needs + error.what


def not_measured(when: str, error: BaseException) -> IdentificationError:
    """Return why something was not measured that the end of a run left out."""
    what = getattr(error, "what", "interrupted")
    return IdentificationError(
        "E_NOT_MEASURED", f"the run ended {when}: {what}", hint="remove the cause, identify again"
    )


def blocking(refused: Mapping[str, str], *, given: bool) -> list[str]:
    """Return the refused quantities without which no control can be designed.

    Parameters
    ----------
    refused : mapping of str to str
        As ``Stage.refused``.
    given : bool
        Whether a person gave a machine file, whose values then stand in.
    """
    needed = ESSENTIAL if given else (*ESSENTIAL, *DESIGNED_FROM)
    return [name for name in needed if name in refused]
