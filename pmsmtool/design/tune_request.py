# SPDX-License-Identifier: MIT
"""What can be asked of a design, checked as a whole."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, get_args

from pmsmtool.design.design_file import Scalar
from pmsmtool.design.loops.current_loop import Method
from pmsmtool.design.loops.speed_loop import SpeedMethod
from pmsmtool.errors import ConfigError
from pmsmtool.machine.key import Key, KeyKind, check_table, not_numbers
from pmsmtool.machine.uncontrolled_generation import Protection
from pmsmtool.params.catalogue import FIELD_WEAKENING_MODES, GOVERNOR_MODES

POLAR_LAWS: Mapping[str, int] = {
    "conventional": 1,
    "proposed": 2,
    "linear": 3,
    "linear-printed": 4,
    "regularised": 5,
    "unified": 6,
}
"""``polar.mode`` of the catalogue."""

SURFACE_ONLY = ("conventional", "proposed", "linear", "linear-printed")
"""Laws of the paper: they hold for L_d = L_q."""

ON_MEASUREMENT, NO_ANTI_WINDUP, PREDICT, LINEAR_RANGE = 1, 2, 4, 8
"""Bits of ``polar.options``: P and D on the measurement, (ablation), prediction, switch to the regularised law."""

PHASE_LAWS = ("conventional", "proposed")
"""Laws of section III: the phase is the input for i_q, which needs speed."""

CONTROLLERS = ("pi", "polar")


@dataclass(frozen=True, slots=True)
class TuneRequest:
    """What is asked of a design; None leaves the choice to the rule named beside it.

    Attributes
    ----------
    controller : str
        ``pi`` (field-oriented) or ``polar`` (voltage amplitude and phase as inputs).
    polar_law : str
        Law of ``polar`` (:data:`POLAR_LAWS`).
    method : str
        Rule of the current gains: ``imc``, ``modulus-optimum`` or ``second-order``.
    bandwidth_hz : float or None
        Bandwidth (natural frequency for ``second-order``) of the current loops; the modulus optimum, lowered where
        the margins ask for it.
    damping : float
        Damping of ``second-order``.
    phase_margin_deg, gain_margin_db : float
        Least margins of the current loops, delay included, and with a flux map at every current up to I_max.
    predictor : bool or None
        One-step prediction of the current (needs a delay of a period); None: where the rotor turns ``PREDICTED_TURN``.
    speed_method : str
        ``symmetric-optimum`` or ``pole-placement``.
    speed_bandwidth_hz : float or None
        Crossover of the speed loop; from ``speed_phase_margin_deg`` by the symmetric optimum.
    speed_phase_margin_deg : float
        Phase margin the symmetric optimum is laid out for.
    speed_damping : float
        Damping of ``pole-placement``.
    speed_decimation : int or None
        Control periods per speed-controller period.
    speed_filter_hz, pll_rad_s : float or None
        Feedback filter and speed estimate.
    notch_hz, notch_zeta_num, notch_zeta_den : float or None, float, float
        Notch on the torque; 0 Hz is off, None: at the machine's resonance where one is known.
    voltage_margin : float
        Share of V_max kept for control in steady state.
    governor : str
        Mode of the reference governor (``catalogue.GOVERNOR_MODES``).
    eps : float or None
        Tightening of its steady-state row.
    field_weakening : str
        Mode of field weakening (``FIELD_WEAKENING_MODES``), or ``auto``: a look-up table for a machine with a flux map,
        the accelerated optimisation for a constant one; for a polar law the table where it knows more than the law
        (``polar_values.weakening_mode``).
    overspeed_protection : str or None
        What holds the DC link at a fault above the speed of uncontrolled generation: ``chopper`` or ``battery`` (a
        person states it), or ``short-circuit``; None: shorted where the magnet stands it, else nothing, which is said.
    """

    controller: str = "pi"
    polar_law: str = "unified"
    method: str = "imc"
    bandwidth_hz: float | None = None
    damping: float = 1.0
    phase_margin_deg: float = 45.0
    gain_margin_db: float = 6.0
    predictor: bool | None = None
    speed_method: str = "symmetric-optimum"
    speed_bandwidth_hz: float | None = None
    speed_phase_margin_deg: float = 60.0
    speed_damping: float = 1.0
    speed_decimation: int | None = None
    speed_filter_hz: float | None = None
    pll_rad_s: float | None = None
    notch_hz: float | None = None
    notch_zeta_num: float = 0.05
    notch_zeta_den: float = 0.5
    voltage_margin: float = 0.08
    governor: str = "best"
    eps: float | None = None
    field_weakening: str = "auto"
    overspeed_protection: Protection | None = None

    def __post_init__(self) -> None:
        if wrong := not_numbers(self):
            raise ConfigError("the request cannot be used", where="tune", violations=wrong)
        choices = {
            "controller": CONTROLLERS,
            "polar_law": tuple(POLAR_LAWS),
            "method": tuple(str(one) for one in Method),
            "speed_method": tuple(str(one) for one in SpeedMethod),
            "governor": tuple(GOVERNOR_MODES),
            "field_weakening": ("auto", *FIELD_WEAKENING_MODES),
            "overspeed_protection": get_args(Protection),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed and (name, getattr(self, name)) != ("overspeed_protection", None):
                wrong.append(f"{name} is {getattr(self, name)!r}, allowed are {', '.join(allowed)}")
        for name in ("bandwidth_hz", "damping", "speed_bandwidth_hz", "speed_damping", "speed_filter_hz", "pll_rad_s"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                wrong.append(f"{name} = {value!r} is not a positive number")
        for name in ("phase_margin_deg", "speed_phase_margin_deg"):
            if not 0.0 < getattr(self, name) < 90.0:
                wrong.append(f"{name} = {getattr(self, name)!r} is not between 0 and 90 degree")
        if not 0.0 <= self.voltage_margin <= 0.5:
            wrong.append(f"voltage_margin = {self.voltage_margin!r} is outside 0..0.5")
        if self.eps is not None and not 0.0 <= self.eps <= 0.5:
            wrong.append(f"eps = {self.eps!r} is outside 0..0.5")
        if self.speed_decimation is not None and not 1 <= self.speed_decimation <= 1000:
            wrong.append(f"speed_decimation = {self.speed_decimation!r} is outside 1..1000")
        if wrong:
            raise ConfigError("the request cannot be used", where="tune", violations=wrong)

    def table(self) -> dict[str, Scalar]:
        """Return what was asked, without what was left open."""
        given = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: value for name, value in given.items() if value is not None}


_KINDS: dict[str, KeyKind] = {"str": "text", "float": "float", "int": "int", "bool": "bool", "Protection": "text"}
_KEYS: tuple[Key, ...] = (
    *(
        Key("request", item.name, _KINDS[str(item.type).split(" ")[0]], "", -1e9, 1e9, None, "what was asked")
        for item in fields(TuneRequest)
    ),
    Key("request", "drive", "text", "", 0, 0, None, "drive map the design is for"),
    Key("request", "axis", "bool", "", 0, 1, None, "whether speed and position loops are those of the axis"),
    Key("request", "axis_phase_margin_deg", "float", "deg", 0, 90, None, "least phase margin of both loops"),
    Key("request", "axis_peak_db", "float", "dB", 0, 60, None, "largest |S| of both loops"),
    Key("request", "axis_speed_filter_hz", "float", "Hz", 1e-3, 1e6, None, "the drive's filter on the speed"),
    Key("request", "loop_rate_hz", "float", "Hz", 1e-3, 1e6, None, "rate of the drive's speed and position loops"),
    Key("request", "drive_bandwidth_hz", "float", "Hz", 1e-3, 1e6, None, "bandwidth of that drive's current loops"),
)


def request_violations(table: Mapping[str, Any], where: str) -> list[str]:
    """Return what is wrong with the ``[request]`` of a design: names, types and what :class:`TuneRequest` refuses."""
    wrong: list[str] = []
    places = {"": f"{where}: [request]", **{name: f"{where}: [request] {name}" for name in table}}
    values: dict[str, Any] = dict(check_table(table, _KEYS, places, wrong, {}))
    try:
        TuneRequest(**{item.name: values[item.name] for item in fields(TuneRequest) if item.name in values})
    except ConfigError as error:
        wrong += [f"{where}: [request] {violation}" for violation in error.violations]
    return wrong
