# SPDX-License-Identifier: MIT
"""Constants of the fixed-point governor (``firmware/fixed_point``) from a parameter set.

Bases are powers of two at least twice the largest value the drive's own limits allow, so that Q4.27 leaves a factor of
sixteen above those; the voltage base is raised further where gains or reactances need it. A value that does not fit is
refused, never wrapped; the error of every rounded value is printed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import resources

from pmsmtool.errors import ConfigError
from pmsmtool.firmware.params_header import SPDX, c_float
from pmsmtool.units import rad_s_from_rpm

BITS = 27
ONE = 1 << BITS
RAISED = 8
"""The voltage base is at most so much above what the limits ask for."""
LARGEST = (1 << 30) - 1
"""Eight base values, where the C code saturates."""
_FAR_LIMITS = "the current or voltage limits are far from what the gains belong to"
_FLOATING = "correct the limits, or export without --fixed-point"

DECOUPLING_AND_EMF = 3
"""Bits of ``current.options`` that the governor's rows rest on."""


@dataclass(frozen=True, slots=True)
class QFormat:
    """Bases and constants of one motor.

    Attributes
    ----------
    I_base, U_base, omega_base : float
        Base values (A, V, electrical rad/s), powers of two.
    constants : mapping of str to (int, float)
        Member of ``pmsm_governor_q_constants`` -> Q4.27 number and its relative rounding error.
    """

    I_base: float
    U_base: float
    omega_base: float
    constants: Mapping[str, tuple[int, float]]


def _power_of_two(x: float) -> float:
    return math.ldexp(1.0, math.ceil(math.log2(x)))


def q_format(values: Mapping[str, float]) -> QFormat:
    """Return bases and constants of a complete set of catalogue values.

    Raises ConfigError: a constant does not fit Q4.27, or the current controller works without decoupling or emf
    feed-forward.
    """
    if int(values["current.options"]) & DECOUPLING_AND_EMF != DECOUPLING_AND_EMF:
        raise ConfigError(
            "the fixed-point governor needs decoupling and emf feed-forward",
            where="current.options",
            hint="set bits 0 and 1",
        )
    if min(values[f"current.K_p_{axis}_v_per_a"] for axis in "dq") <= 0.0:
        raise ConfigError(
            "the fixed-point governor needs a proportional current controller",
            where="current.K_p",
            hint="`pmsmtool tune` gives one; without --fixed-point none is needed",
        )
    I_base = _power_of_two(2.0 * max(values["motor.I_max_apk"], values["governor.I_transient_apk"]))
    U_base = _power_of_two(2.0 * values["inverter.voltage_utilisation"] * values["protection.U_dc_max_v"])
    speed = max(values["motor.n_max_rpm"], values["protection.n_trip_rpm"])
    omega_base = _power_of_two(rad_s_from_rpm(2.0 * values["motor.pole_pairs"] * speed))
    numbers = _numbers(values, I_base, U_base, omega_base)
    most = RAISED * U_base
    while U_base < most and max(numbers.values()) > LARGEST / ONE:
        U_base *= 2.0
        numbers = _numbers(values, I_base, U_base, omega_base)
    return QFormat(I_base, U_base, omega_base, {name: _rounded(name, x) for name, x in numbers.items()})


def _numbers(values: Mapping[str, float], I_base: float, U_base: float, omega_base: float) -> dict[str, float]:
    """Members of the C structure per unit of their bases."""
    ohm, henry = I_base / U_base, I_base * omega_base / U_base
    K_p = {axis: values[f"current.K_p_{axis}_v_per_a"] * ohm for axis in "dq"}
    return {
        "K_p_d": K_p["d"],
        "K_p_q": K_p["q"],
        "inverse_K_p_d": 1.0 / K_p["d"],
        "inverse_K_p_q": 1.0 / K_p["q"],
        "R_s": values["motor.R_s_ohm"] * ohm,
        "L_d": values["motor.L_d_app_h"] * henry,
        "L_q": values["motor.L_q_app_h"] * henry,
        "psi_f": values["motor.psi_f_wb"] * omega_base / U_base,
        "steady_share": 1.0 - values["governor.eps"],
        "slack": values["governor.slack"],
    }


def _rounded(name: str, x: float) -> tuple[int, float]:
    q = round(x * ONE)
    if q > LARGEST:
        raise ConfigError(
            f"{name} is {x:.6g} of its base value, more than Q4.27 of the fixed-point governor holds (8)",
            likely=_FAR_LIMITS,
            hint=_FLOATING,
        )
    if q == 0 and x != 0.0:
        raise ConfigError(
            f"{name} is {x:.3g} of its base value and vanishes in Q4.27", likely=_FAR_LIMITS, hint=_FLOATING
        )
    return q, (q / ONE - x) / x if x else 0.0


def q_files(values: Mapping[str, float], *, prefix: str = "pmsm", design_id: str = "") -> dict[str, str]:
    """Return file name -> text of the fixed-point governor and of its constants."""
    q = q_format(values)
    return {
        f"{prefix}_cfg_q.h": _header(q, prefix, design_id),
        f"{prefix}_cfg_q.c": _source(q, prefix),
        **dict(fixed_point_files()),
    }


def fixed_point_files() -> Iterator[tuple[str, str]]:
    """Yield (name, text) of every C file of the fixed-point governor, in name order."""
    folder = resources.files("pmsmtool.firmware").joinpath("fixed_point")
    for entry in sorted(folder.iterdir(), key=lambda item: item.name):
        if entry.name.endswith((".c", ".h")):
            yield entry.name, entry.read_text(encoding="ascii")


def _header(q: QFormat, prefix: str, design_id: str) -> str:
    up, guard = prefix.upper(), f"{prefix.upper()}_CFG_Q_H"
    return f"""{SPDX}
/* {prefix}_cfg_q.h: generated by pmsmtool export, do not edit.
 * design {design_id or "not named"}
 * Constants and signals of the fixed-point governor are Q4.27 of these base values. They are powers of two, at least
 * twice what the limits of the drive allow.
 */
#ifndef {guard}
#define {guard}

#include "pmsm_governor_q.h"

#define {up}_Q_I_BASE_A {c_float(q.I_base)}
#define {up}_Q_U_BASE_V {c_float(q.U_base)}
#define {up}_Q_OMEGA_BASE_RAD_S {c_float(q.omega_base)} /* electrical */

#ifdef __cplusplus
extern "C" {{
#endif

extern const pmsm_governor_q_constants {prefix}_cfg_q;

#ifdef __cplusplus
}}
#endif

#endif
"""


def _source(q: QFormat, prefix: str) -> str:
    worst = max(abs(error) for _, error in q.constants.values())
    lines = [
        f"        .{name} = {number}, /* {number / ONE:.9g}, rounded by {error:+.1e} of the value */"
        for name, (number, error) in q.constants.items()
    ]
    return "\n".join(
        [
            f"{SPDX}\n/* {prefix}_cfg_q.c: generated by pmsmtool export, do not edit.",
            f" * Largest rounding error of a constant: {worst:.1e} of its value.",
            " */",
            f'#include "{prefix}_cfg_q.h"',
            "",
            f"const pmsm_governor_q_constants {prefix}_cfg_q = {{",
            *(line[4:] for line in lines),
            "};",
            "",
        ]
    )
