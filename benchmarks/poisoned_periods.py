# SPDX-License-Identifier: MIT
"""Poisoned periods: one input of the control core is no usable number, for one period or for two running.

Run from the repository: ``python benchmarks/poisoned_periods.py [--periods 1000000] [--seed 1]``; about two minutes of
one core for a million. Random machines of 24 to 560 V run every control law of the core in every mode that asks
something of it, at up to 1.2 of their base speed. Between 3 and 12 good periods, one input or a word of the look-up
table becomes NaN, infinite, 1e30 or a denormal number; every fifth time for two periods. Each episode runs beside a
twin that has seen good periods only.

Counted, each a failure: duty ratios that are no numbers while the gates are on; a single bad period that latches a
fault or leaves the voltage; two that are not reported as a latched fault; a current that is off the twin's by more than
``AWAY`` after the second good period, where the twin's is steady. Exit code 1 when one of them occurs.
"""

from __future__ import annotations

import argparse
import cmath
import ctypes
import math
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from pmsmtool.firmware.core_binding import core
from tests.firmware.closed_loop import DEFAULTS, MODE_CURRENT, MODE_SPEED, MODE_TORQUE, MODE_VOLTAGE, Loop

POISON = (math.nan, math.inf, -math.inf, 1e30, -1e30, 1e-41)
SAMPLED = ("i_a", "i_b", "i_c", "theta_e", "omega_e", "U_dc", "T_winding")
ASKED = ("i_d_ref", "i_q_ref", "tau_ref", "omega_M_ref", "u_d_inject", "u_q_inject", "bias_bandwidth")
TABLE, NODES = "table", "saturation"
LAWS: dict[str, dict[str, float]] = {
    "pi": {},
    "pi, clip": {"current.options": 3},
    "pi, hexagon": {"current.options": 15},
    "pi, predictor": {"current.options": 23},
    **{
        f"governor {mode}{text}": {
            "governor.mode": mode,
            "governor.options": 12 | bits,
            "current.options": 7 | 8 * bits,
        }
        for mode in (1, 2, 3, 4, 5)
        for bits, text in ((0, ""), (2, ", predictor"))
    },
    "governor 3, minimum time": {"governor.mode": 3, "governor.options": 28},
    "governor 3, hexagon": {"governor.mode": 3, "governor.options": 31, "current.options": 23},
    **{f"polar {mode}": {"polar.mode": mode} for mode in range(1, 7)},
    "saturated, pi": {},
    "saturated, pi, predictor": {"current.options": 23},
    "saturated, line": {"governor.mode": 2, "governor.options": 12},
    "saturated, best": {"governor.mode": 3, "governor.options": 28},
    "saturated, best, predictor": {"governor.mode": 3, "governor.options": 30, "current.options": 23},
}
"""Values of the catalogue that choose a law. The predictor's bit is 4 of the current options, 2 of the governor's."""
WEAKENING = (0, 1, 2, 3, 4)
NOT_TUNED = ("polar 1", "polar 2", "polar 3", "polar 4")
"""Laws of a paper at its pole positions: on drawn machines they swing slowly, with or without bad samples, and are not
judged by a twin."""
AWAY = 0.15
"""Flux beside the twin's after the second good period, over what V_max changes in one; 0.123 at most of 10^6."""
QUIET = 0.1
"""A twin whose flux moves by less, in that unit, is steady: laws that no rule has tuned for a drawn machine swing. Nor
may its voltage change by more of V_max in the bad period: held for that long, the old one moves the flux by as much."""


def draw_machine(rng: np.random.Generator) -> dict[str, float]:
    """Return catalogue values of a random machine with gains at a tenth to a third of its sampling rate."""
    U_dc, I_max = rng.choice([24.0, 48.0, 210.0, 325.0, 560.0]), 10.0 ** rng.uniform(0.5, 2.2)
    T_s, p = 1.0 / rng.uniform(8e3, 24e3), int(rng.integers(1, 9))
    V_max, omega = U_dc / math.sqrt(3.0), rng.uniform(300.0, 1600.0)
    psi = rng.uniform(0.5, 0.75) * V_max / omega
    L_d = rng.uniform(0.1, 0.5) * V_max / (omega * I_max)
    L_q, R = L_d * rng.uniform(0.9, 3.0), rng.uniform(0.01, 0.1) * V_max / I_max
    alpha = rng.uniform(0.05, 0.2) / T_s
    values = DEFAULTS | {
        "motor.pole_pairs": p, "motor.R_s_ohm": R, "motor.psi_f_wb": psi, "motor.I_max_apk": I_max,
        "motor.I_nom_apk": 0.5 * I_max, "protection.I_cont_apk": 0.5 * I_max, "governor.I_transient_apk": I_max,
        "motor.n_max_rpm": 1.2 * omega / p * 30.0 / math.pi, "inverter.T_s_ns": round(1e9 * T_s),
        "inverter.delay_periods": float(rng.choice([0.5, 1.5])), "inverter.U_dc_nom_v": U_dc,
        "inverter.deadtime_compensation": int(rng.integers(2)), "inverter.V_dead_v": 0.01 * U_dc,
        "inverter.i_knee_apk": 0.05 * I_max, "governor.alpha_rad_s": alpha, "governor.k_max": 5,
        "field_weakening.i_d_min_a": -I_max, "field_weakening.h2": 1e-3, "speed.tau_max_nm": 1.5 * p * psi * I_max,
        "speed.K_p_nms_per_rad": 0.1 * p * psi * I_max / omega, "speed.K_i_nm_per_rad": p * psi * I_max / omega,
    }  # fmt: skip
    for axis, L in (("d", L_d), ("q", L_q)):
        values |= {f"motor.L_{axis}_h": L, f"motor.L_{axis}_app_h": L}
        values |= {f"current.K_p_{axis}_v_per_a": alpha * L, f"current.K_i_{axis}_v_per_as": alpha * R}
    return values


def table_of(values: dict[str, float], rng: np.random.Generator) -> tuple[dict[str, float], bytes]:
    """Return descriptor and words of a small binary32 table with field-weakening currents, some cells empty."""
    tau, n = values["speed.tau_max_nm"], values["motor.n_max_rpm"]
    torque, speed, link = np.linspace(-tau, tau, 7), np.linspace(-n, n, 5), np.array([values["inverter.U_dc_nom_v"]])
    i_q = np.repeat(torque[:, None] / (1.5 * values["motor.pole_pairs"] * values["motor.psi_f_wb"]), 5, axis=1)
    i_d = -0.3 * values["motor.I_max_apk"] * np.abs(speed / n)[None, :] * np.ones((7, 1))
    i_d[rng.uniform(size=i_d.shape) < 0.05] = np.nan
    words = np.concatenate([np.asarray(x, np.float32).ravel() for x in (torque, speed, link, i_d, i_q)]).tobytes()
    return {"lut.format": 1, "lut.axis_kind": 0, "lut.n_x": 7, "lut.n_y": 5, "lut.n_z": 1}, words


def saturation_of(values: dict[str, float], rng: np.random.Generator) -> tuple[dict[str, float], bytes]:
    """Return descriptor and words of a saturation table; the inductances fall by up to a quarter at I_max."""
    I_max, n, falls = values["motor.I_max_apk"], 5, rng.uniform(0.05, 0.25)
    i_d, i_q = np.meshgrid(np.linspace(-1.1, 0.5, n) * I_max, np.linspace(0.0, 1.1, n) * I_max, indexing="ij")
    share = 1.0 - falls * np.minimum(1.0, (i_d**2 + i_q**2) / I_max**2)
    L_d, L_q = values["motor.L_d_h"] * share, values["motor.L_q_h"] * share
    nodes = np.stack([values["motor.psi_f_wb"] + L_d * i_d, L_q, L_d, L_q], axis=-1)
    descriptor = {
        "saturation.n_d": n, "saturation.n_q": n, "saturation.i_d_min_a": -1.1 * I_max,
        "saturation.i_d_max_a": 0.5 * I_max, "saturation.i_q_max_a": 1.1 * I_max,
    }  # fmt: skip
    return descriptor, nodes.astype(np.float32).tobytes()


class Case:
    """A drawn machine under one law, in one mode, at a constant speed."""

    def __init__(self, rng: np.random.Generator, law: str) -> None:
        values = draw_machine(rng) | LAWS[law]
        self.mode = int(rng.choice([MODE_CURRENT, MODE_TORQUE, MODE_TORQUE, MODE_SPEED, MODE_VOLTAGE]))
        self.law, weakening = law, int(rng.choice(WEAKENING))
        values["field_weakening.mode"] = weakening
        lut = b""
        if weakening == 1:
            chosen, lut = table_of(values, rng)
            values |= chosen
        self.words = {TABLE: (0, len(lut) // 4)}
        if law.startswith("saturated"):
            chosen, nodes = saturation_of(values, rng)
            self.words[NODES] = (len(lut) // 4, (len(lut) + len(nodes)) // 4)
            values, lut = values | chosen, lut + nodes
        omega = rng.uniform(-1.2, 1.2) * 0.6 * values["inverter.U_dc_nom_v"] / math.sqrt(3.0) / values["motor.psi_f_wb"]
        self.loop = Loop(core(), values, omega=omega, U_dc=values["inverter.U_dc_nom_v"], lut=lut)
        self.asked = {
            "i_d_ref": -0.3 * rng.uniform() * values["motor.I_max_apk"],
            "i_q_ref": rng.uniform(-0.7, 0.7) * values["motor.I_max_apk"],
            "tau_ref": rng.uniform(-0.7, 0.7) * values["speed.tau_max_nm"],
            "omega_M_ref": omega / values["motor.pole_pairs"],
            "bias_bandwidth": float(rng.choice([0.0, 0.0, 0.0, 100.0])),
        }
        self.V_max = values["inverter.voltage_utilisation"] * self.loop.U_dc
        self.inputs = [*SAMPLED, *ASKED, *(name for name, (first, end) in self.words.items() if end > first)]

    def flux(self, i: np.ndarray) -> float:
        """Return the flux of a current (A) over what V_max changes in a period."""
        plant = self.loop.plant
        return math.hypot(plant.L_d * i[0], plant.L_q * i[1]) / (self.V_max * plant.T_s)

    def good(self) -> None:
        """One period as it should be."""
        self.loop.step(mode=self.mode, **self.asked)

    def bad(self, name: str, value: float, word: int) -> None:
        """One period with one input replaced."""
        loop, m, r = self.loop, self.loop.measurement, self.loop.reference
        m.i_a, m.i_b, m.i_c = loop.plant.phases()
        m.theta_e, m.omega_e = loop.plant.theta, loop.plant.omega
        T, kept = m.T_winding, None
        if name in self.words:
            assert loop.lut is not None
            kept = loop.lut[word]
            loop.lut[word] = int(np.float32(value).view(np.uint32))
        else:
            setattr(m if name in SAMPLED else r, name, value)
        loop.binding.library.pmsm_step(loop.state, loop.params, loop.lut, m, r, loop.output)
        m.T_winding, m.U_dc = T, loop.U_dc
        for asked, number in {"u_d_inject": 0.0, "u_q_inject": 0.0, **self.asked}.items():
            setattr(r, asked, number)
        if kept is not None and loop.lut is not None:
            loop.lut[word] = kept
        out = loop.output
        ab = loop.U_dc * (2 * out.duty_a - out.duty_b - out.duty_c) / 3, loop.U_dc * (out.duty_b - out.duty_c) / 3**0.5
        loop.plant.advance(*(out.gates * np.nan_to_num(np.array(ab))))


def duties(output: Any) -> np.ndarray:
    """Return the duty ratios."""
    return np.array([output.duty_a, output.duty_b, output.duty_c])


def copy_of(loop: Loop) -> tuple[bytes, np.ndarray, np.ndarray, float]:
    """Return everything that a period changes."""
    return bytes(loop.state), loop.plant.i.copy(), loop.plant.waiting.copy(), loop.plant.theta


def restore(loop: Loop, kept: tuple[bytes, np.ndarray, np.ndarray, float]) -> None:
    """Put it back."""
    ctypes.memmove(ctypes.byref(loop.state), kept[0], len(kept[0]))
    loop.plant.i, loop.plant.waiting, loop.plant.theta = kept[1].copy(), kept[2].copy(), kept[3]


def is_number(name: str, value: float) -> bool:
    """Whether the core may take it: a denormal is a small number (but as a bandwidth), no temperature is no sensor."""
    if name in (TABLE, NODES) or (name == "T_winding" and math.isnan(value)):
        return True
    return abs(value) < 1.0 and name != "bias_bandwidth"


def voltage(output: Any) -> complex:
    """Return the stator-frame voltage of a period."""
    return complex(output.u_alpha, output.u_beta)


def episode(case: Case, rng: np.random.Generator, found: Counter[str]) -> float:
    """One or two bad periods after some good ones; count what is wrong. Returns the flux beside the twin's."""
    loop = case.loop
    for _ in range(int(rng.integers(3, 13))):
        case.good()
    before, start = voltage(loop.output), copy_of(loop)
    count, name = (2 if rng.uniform() < 0.2 else 1), str(rng.choice(case.inputs))
    value, word = float(rng.choice(POISON)), int(rng.integers(*case.words.get(name, (0, 1))))
    case.good()
    turned = before * cmath.exp(1j * loop.plant.omega * loop.plant.T_s)
    changed = abs(voltage(loop.output) - turned) / case.V_max
    for _ in range(count + 1):
        case.good()
    twin = loop.plant.i.copy()
    restore(loop, start)
    usable = is_number(name, value)
    for k in range(count):
        case.bad(name, value, word)
        found["bad periods"] += 1
        found["no number with gates on"] += int(bool(loop.output.gates) and not np.isfinite(duties(loop.output)).all())
        if not usable and k == 0:
            found["not held"] += int(abs(voltage(loop.output) - turned) > 1e-3 * case.V_max)
            found["latched by one"] += int(loop.state.fault != 0)
    if not usable and count == 2:
        found["not latched by two"] += int(loop.state.fault == 0 or loop.output.gates != 0)
        case.good()
        found["not reported"] += int(not loop.state.live.flags & 1 << 12 or loop.output.gates != 0)
        loop.binding.library.pmsm_reset_fault(loop.state)
        restore(loop, start)
        return 0.0
    if loop.state.fault != 0:
        found["latched by a number"] += 1
        restore(loop, start)
        return 0.0
    for _ in range(2):
        case.good()
        found["no number with gates on"] += int(not np.isfinite(duties(loop.output)).all())
    away = case.flux(loop.plant.i - twin)
    moved = max(changed, case.flux(twin - start[1]))
    if (usable and (name != NODES or abs(value) < 1.0)) or case.law in NOT_TUNED or moved > QUIET:
        return 0.0
    found["judged by the twin"] += 1
    found["not back"] += int(not away <= AWAY or loop.output.gates == 0)
    return away


def run(periods: int, seed: int, episodes: int = 40) -> tuple[Counter[str], dict[str, float]]:
    """Run until that many bad periods; return the counts, and the largest distance from the twin by input."""
    rng = np.random.default_rng(seed)
    found: Counter[str] = Counter()
    away: dict[str, list[float]] = {}
    laws = list(LAWS)
    k = 0
    while found["bad periods"] < periods:
        case = Case(rng, laws[k % len(laws)])
        k += 1
        for _ in range(60):
            case.good()
        for _ in range(episodes):
            away.setdefault(case.law, []).append(episode(case, rng, found))
    found["machines"] = k
    return found, {name: max(values) for name, values in away.items()}


FAILURES = (
    "no number with gates on", "not held", "latched by one", "not latched by two", "not reported",
    "latched by a number", "not back",
)  # fmt: skip


def main() -> int:
    """Print the counts; exit code 1 when something failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--periods", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    found, away = run(asked.periods, asked.seed)
    print(f"{found['bad periods']} bad periods on {found['machines']} machines, {len(LAWS)} laws")
    for name in (*FAILURES, "judged by the twin"):
        print(f"{name:28s} {found[name]}")
    for name, value in away.items():
        print(f"{name:28s} {value:.3f} of a period's flux beside the twin's, at most")
    return int(any(found[name] for name in FAILURES))


if __name__ == "__main__":
    sys.exit(main())
