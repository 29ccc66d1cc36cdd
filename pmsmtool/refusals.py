# SPDX-License-Identifier: MIT
"""The named refusals of identification: what was detected, what usually causes it, what to do next.

One table; ``pmsmtool help refusals`` prints it, and every estimator raises through :func:`refuse`, so that a message
always carries the stage, what was measured, the limit, the likely cause and the next step (docs/identification.md,
7).
"""

from __future__ import annotations

from dataclasses import dataclass

from pmsmtool.errors import IdentificationError


@dataclass(frozen=True, slots=True)
class Refusal:
    """One named reason to give no number."""

    name: str
    meaning: str
    likely: str
    next_step: str


_ROWS: tuple[tuple[str, str, str, str], ...] = (
    (
        "E_NOT_CONNECTED",
        "no current flows in any of the three test vectors",
        "motor cable not connected, gates blocked, or a contactor is open",
        "check the motor cable and the enable chain, then repeat",
    ),
    (
        "E_PHASE_OPEN",
        "one phase carries no current",
        "a broken lead, a loose terminal or a dead half bridge",
        "measure the three line-line resistances with a meter",
    ),
    (
        "E_UNBALANCED",
        "the three phases differ by more than 10 %",
        "a bad joint, a shorted turn, or one current sensor with a wrong gain",
        "measure the three line-line resistances with a meter, then the sensor gains",
    ),
    (
        "E_ROTOR_MOVED",
        "the rotor moved during a measurement at standstill",
        "free shaft and too slow an injection, or a load that pulls",
        "take away what pulls on the shaft, or lower the current (--i-max)",
    ),
    (
        "E_NO_MAGNET",
        "the rotor follows a vector, but a q current makes no torque in it",
        "a reluctance machine without magnets; L_d is that of the axis that a vector pulls onto itself",
        "use R_s, pole pairs and inductances of this run; control is designed for machines with magnets only",
    ),
    (
        "E_MAGNET_CHANGED",
        "the flux linkage after the pulses of the flux map is not the one before them",
        "magnets that the d current of the pulses has demagnetised in part",
        "state an i_d_min_apk well inside that current in the machine file, then identify this rotor again",
    ),
    (
        "E_CLIPPED",
        "samples in the fit window were limited or at full scale",
        "the amplitude exceeds the voltage limit, the current limit or the converter's range",
        "lower the amplitude (--i-max), or raise the DC-link voltage",
    ),
    (
        "E_NOT_SETTLED",
        "the quantity still drifts at the end of its settling time",
        "a rotor that swings, a slow current loop, or heating",
        "let the rotor rest and the winding cool down, then repeat; or lower the current (--i-max)",
    ),
    (
        "E_SNR",
        "the predicted standard deviation is above the limit",
        "too small an amplitude for the noise of this current measurement, or the machine file of another motor",
        "raise the amplitude (--i-max); `pmsmtool check MACHINE` compares the file with what is connected",
    ),
    (
        "E_COHERENCE",
        "the answer is not explained by the excitation",
        "too small an excitation for the encoder's resolution, or a shaft that something else moves",
        "allow more current (--i-max) or speed (--speed-max), or take the load's motion away",
    ),
    (
        "E_MODEL_MISMATCH",
        "the residual is larger than the noise explains",
        "an effect that is not in the model: saturation, eddy currents, a moving rotor, a lagging sensor",
        "look at the residual in the report; change the amplitude (--i-max)",
    ),
    (
        "E_NOT_IDENTIFIABLE",
        "two quantities cannot be separated with these data",
        "too narrow a range of current or speed",
        "widen the range: allow more current (--i-max) or speed (--speed-max)",
    ),
    (
        "E_THERMAL_DRIFT",
        "the first and the last repetition differ: the winding changed its temperature",
        "too much energy in the sweep",
        "wait until it has cooled down, lower --i-max or connect the temperature sensor",
    ),
    (
        "E_CURRENT_SENSOR",
        "offsets or gains of the phase current sensors differ",
        "a drifted or damaged sensor, or a wrong scale of one phase",
        "calibrate the current sensors",
    ),
    (
        "E_NOT_CONVERGED",
        "the fit did not converge",
        "data that do not look like the model at all",
        "look at the trace in the report",
    ),
    (
        "E_FREQUENCY_DEPENDENT",
        "two injection frequencies give different inductances",
        "eddy currents in the core or the magnets",
        "use the value of the frequency that the current loop will see; both are in the record",
    ),
    (
        "E_ENCODER",
        "the encoder does not count while the current vector turns the rotor",
        "an encoder that is stuck or not coupled, or a shaft that is locked without --shaft locked",
        "turn the shaft by hand and watch theta_m in `pmsmtool monitor`",
    ),
    (
        "E_HALL",
        "the Hall wires do not show three sensors a third of an electrical turn apart",
        "a wire that is open or shorted, no supply at the sensors, or sensors 60 degrees apart",
        "measure the three wires while you turn the shaft by hand: each is high for half an electrical turn",
    ),
    (
        "E_VENDOR_VALUE",
        "the drive's own identification gives a number that no machine has",
        "the drive works with R, L or pole pairs of another machine, or the map reads another firmware",
        "look at its answers (vendor_tuning.json of the run), and at the parameters it is set to",
    ),
    (
        "E_POLE_PAIRS",
        "the measured number of pole pairs is not an integer",
        "the rotor slips or is loaded, or the encoder resolution is set wrongly",
        "free the shaft, raise the current (--i-max), check the increments per turn",
    ),
    (
        "E_NOT_SET_UP",
        "the drive's encoder offset, pole pairs or psi_f are the factory's or another motor's; a held rotor needs them",
        "a drive that was not set up for this motor",
        "free the shaft and `commission`, which measures and stores them; then hold the rotor",
    ),
    (
        "E_EXCITATION",
        "the recorded signal does not contain the excitation the method needs",
        "the drive aborted the excitation, or recorded something else",
        "look at the trace in the report and at the abort limits",
    ),
    (
        "E_TRACK_LOST",
        "the filter's innovations are not consistent with its model",
        "wrong inductances or inverter table, or no excitation",
        "repeat the identification of L and of the inverter",
    ),
)

REFUSALS: dict[str, Refusal] = {row[0]: Refusal(*row) for row in _ROWS}
"""All named refusals."""


def refuse(name: str, what: str, *, stage: str, likely: str = "", hint: str = "") -> IdentificationError:
    """Return the error of a named refusal; ``what`` states the measured value and the limit.

    Parameters
    ----------
    name : str
        Key of :data:`REFUSALS`.
    what : str
        One sentence with the measured value and the limit it hit.
    stage : str
        The measurement, e.g. ``resistance`` or ``inductance, q axis``.
    likely, hint : str
        Replace the table's cause and next step where more is known.
    """
    row = REFUSALS[name]
    return IdentificationError(name, what, where=stage, likely=likely or row.likely, hint=hint or row.next_step)
