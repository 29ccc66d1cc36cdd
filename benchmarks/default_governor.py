# SPDX-License-Identifier: MIT
"""The design as ``tune`` makes it unasked, on drawn machines: what its governor is worth, whether it keeps I_max.

Run from the repository: ``python benchmarks/default_governor.py [--machines 24] [--seed 1] [--steps 12]``; some two
seconds per machine. A third of the machines is saturated (around the profile ``saturated-pmsyrm``), a third has a
saliency of 1.5 to 3, a third less; delay 1.5 periods. Each law drives the project's own plant with ideal sensors and an
ideal bridge at a constant speed of up to 1.2 of the base speed either way: from one reachable current to another, or to
one that the voltage does not reach. Settled: within 2 % of the step (1 % of I_max at least) of where the current ends.
*Voltage binds*: reachable steps in which the law without governor demands more than V_max after the step.

``--noise 0.0018`` adds white noise to the phase currents (of I_max, rms: 0.1 A on 56 A). ``--second-plant`` takes motor
and bridge of ``benchmarks/second_plant``, and for the saturated third its machine of a closed form, each constant drawn
around those of ``saturated-pmsyrm``; the design has the flux map of 53 x 53 nodes of the same form.

Laws: the default; the same without governor; both with predictor. Settling is compared case by case. Exit code 1: the
default exceeds ``OVER``, is slower than ``SLOWER`` on reachable steps, or settles later than ``LATE_P95_MS`` (95 %) or
``LATEST_MS`` where the voltage does not reach the reference.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks import second_plant
from benchmarks.analytic_saturation import BridgeSaturation, saturated_pmsyrm_map
from benchmarks.random_drives import draw_around, draw_drive
from pmsmtool.design.operating_machine import at_temperature
from pmsmtool.design.ratings import ratings
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.machine.machine_file import MachineFile, load_machine_file, machine_path
from pmsmtool.papers.governed_drive import IDEAL
from pmsmtool.papers.statistics import BAND
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.sim.closed_loop import simulate
from pmsmtool.sim.kernel import Application
from pmsmtool.sim.scenarios import Scenario

BEFORE_S, AFTER_S = 0.06, 0.12
"""The start is held this long, and the target."""
HELD_SHARE, MISSED_SHARE = 0.90, 1.05
"""A reachable current takes at most this much of V_max, an unreachable one at least."""
OVER = 1.05
"""Largest current over I_max."""
SLOWER = 1.02
"""Upper end of the interval of the paired settling, over that without governor."""
LATE_P95_MS, LATEST_MS = 12.0, 40.0
"""Settling on references out of reach."""
FORM_SPREAD = 0.15
"""Standard deviation of the logarithm of each constant of a closed form."""
TRIES = 50_000
"""Of a machine's steps. Some machines have no speed that holds one current and keeps another out of reach."""
KINDS = ("linear", "salient", "saturated")
REQUESTS = {
    "default": TuneRequest(),
    "no governor": TuneRequest(governor="off"),
    "predictor": TuneRequest(predictor=True),
    "predictor, no governor": TuneRequest(predictor=True, governor="off"),
}


def draw(kind: str, seed: int) -> MachineFile:
    """Return a machine of a kind, its sensors and bridge ideal."""
    rng = np.random.default_rng([20261123, seed])
    if kind == "saturated":
        base = draw_around(load_machine_file(machine_path("saturated-pmsyrm")), seed, spread=0.2)
    else:
        base = draw_drive(seed)
        low, high = (1.0, 1.5) if kind == "linear" else (1.5, 3.0)
        L_d = base.machine.L_d_h
        base = replace(base, machine=replace(base.machine, L_q_h=L_d * float(rng.uniform(low, high))))
    truth = {"R_s_ohm": base.machine.R_s_ohm} if kind == "saturated" else {}
    return replace(base, simulation={**IDEAL, **truth}, inverter=replace(base.inverter, V_dead_v=0.0))


def draw_form(seed: int) -> tuple[BridgeSaturation, MachineFile]:
    """Return a saturating machine as a closed form, and the same machine by its flux map."""
    form = BridgeSaturation()
    factors = np.exp(FORM_SPREAD * np.random.default_rng([20261127, seed]).standard_normal(8))
    form = BridgeSaturation(*(x * y for x, y in zip(astuple(form), factors, strict=True)))
    return form, replace(draw("saturated", seed), flux_map=saturated_pmsyrm_map(form))


Step = tuple[float, tuple[float, float], tuple[float, float]]
"""Speed (rpm), start and target (A)."""


class Steps:
    """Random steps of one machine: speed (rpm), start and target (A)."""

    def __init__(self, source: MachineFile, seed: int) -> None:
        self.source, self.rng = source, np.random.default_rng([7, seed])
        self.rated = ratings(source, 0.92 * source.inverter.V_max_v)
        self.machine = at_temperature(source.machine, source.flux_map)

    def voltage(self, i: tuple[float, float], rpm: float) -> float:
        """Share of V_max that holds a current."""
        machine = self.machine
        omega = rpm * math.pi / 30.0 * machine.pole_pairs
        psi_d, psi_q = (float(x) for x in machine.flux(*i))
        u = machine.R * i[0] - omega * psi_q, machine.R * i[1] + omega * psi_d
        return math.hypot(*u) / self.source.inverter.V_max_v

    def current(self) -> tuple[float, float]:
        """Any current inside I_max and the limit of i_d."""
        while True:
            radius, angle = self.rated.I_max_apk * math.sqrt(self.rng.uniform()), self.rng.uniform(-math.pi, math.pi)
            i = radius * math.cos(angle), radius * math.sin(angle)
            if self.rated.i_d_min_a <= i[0] <= 0.3 * self.rated.I_max_apk:
                return i

    def draw(self, reachable: bool, count: int) -> list[Step]:
        """Draw steps; fewer or none where a machine has hardly any or none."""
        found: list[Step] = []
        for _ in range(TRIES):
            if len(found) == count:
                break
            rpm = float(self.rng.uniform(-1.2, 1.2)) * self.rated.base_speed_rpm
            start, target = self.current(), self.current()
            share = self.voltage(target, rpm)
            good = share <= HELD_SHARE if reachable else share >= MISSED_SHARE
            if (
                good
                and self.voltage(start, rpm) <= HELD_SHARE
                and math.dist(start, target) > 0.2 * self.rated.I_max_apk
            ):
                found.append((rpm, start, target))
        return found


def run(source: MachineFile, params: ParameterSet, step: Step) -> tuple[float, float, bool]:
    """Return settling (s; the whole time when it does not settle), largest current (A), and whether V_max was passed.

    The last: the demanded voltage after the step.
    """
    rpm, start, target = step
    schedule = {
        name: ((0.0, a), (BEFORE_S, a), (BEFORE_S, b))
        for name, a, b in zip(("i_d_a", "i_q_a"), start, target, strict=True)
    }
    scenario = Scenario("step", BEFORE_S + AFTER_S, "current", {**schedule, "driven_rpm": ((0.0, rpm),)}, "driven", rpm)
    trace = simulate(source, params, scenario, application=Application.CORE)
    i = np.stack([trace["i_d_true_a"], trace["i_q_true_a"]])
    k = int(np.searchsorted(trace.t_s, BEFORE_S - 1e-9))
    before = i[:, k - 50 : k].mean(axis=1)
    after = i[:, k:]
    end = after[:, -200:].mean(axis=1)
    band = max(BAND * math.dist(before, end), 0.01 * (source.machine.I_max_apk or 1.0))
    off = np.flatnonzero(np.hypot(*(after - end[:, None])) > band)
    settled = (0 if not len(off) else int(off[-1]) + 1) * float(trace.t_s[1] - trace.t_s[0])
    demanded = np.hypot(trace["u_d_v"], trace["u_q_v"])[k:].max()
    return settled, float(np.hypot(*after).max()), bool(demanded > 1.001 * source.inverter.V_max_v)


def plant(second: bool, form: BridgeSaturation | None) -> contextlib.AbstractContextManager[object]:
    """Return the context in which the machine is simulated."""
    if form is not None:
        return second_plant.saturated(form)
    return second_plant.used() if second else contextlib.nullcontext()


def ratio(pairs: np.ndarray) -> tuple[float, float, float]:
    """Geometric mean of the first column over the second, with its 95 % interval by the bootstrap."""
    log = np.log(pairs[:, 0] / pairs[:, 1])
    draws = np.random.default_rng(1).choice(log, (2000, len(log))).mean(axis=1)
    mean, low, high = (float(x) for x in np.exp([log.mean(), *np.percentile(draws, (2.5, 97.5))]))
    return mean, low, high


def main() -> int:
    """Print the tables; exit code 1 where a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", type=int, default=24)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--kind", choices=KINDS)
    parser.add_argument("--noise", type=float, default=0.0, metavar="SHARE")
    parser.add_argument("--second-plant", action="store_true")
    parser.add_argument("--list", action="store_true", help="print every case")
    asked = parser.parse_args()
    rows: dict[str, list[tuple[str, int, bool, bool, float, float]]] = {law: [] for law in REQUESTS}
    for k in range(asked.machines):
        kind = asked.kind or KINDS[k % len(KINDS)]
        form, source = None, draw(kind, 1000 * asked.seed + k)
        if asked.second_plant and kind == "saturated":
            form, source = draw_form(1000 * asked.seed + k)
        steps = Steps(source, 1000 * asked.seed + k)
        cases = [(reachable, step) for reachable in (True, False) for step in steps.draw(reachable, asked.steps)]
        noise = {"sensor_noise_apk": asked.noise * steps.rated.I_max_apk}
        drive = replace(source, simulation={**source.simulation, **noise})
        sets = {law: tune(source, request).parameter_set() for law, request in REQUESTS.items()}
        with plant(asked.second_plant, form):
            binds = [run(drive, sets["no governor"], step)[2] for _, step in cases]
            for law, params in sets.items():
                for n, (reachable, step) in enumerate(cases):
                    settled, peak, _ = run(drive, params, step)
                    rows[law].append((kind, k, reachable, binds[n], settled, peak / steps.rated.I_max_apk))
                    if asked.list:
                        print(law, kind, k, n, reachable, step, f"{1e3 * settled:.2f} ms", f"{rows[law][-1][-1]:.3f}")
    failed = False
    for kind in KINDS:
        for reachable in (True, False):
            chosen = {law: np.array([r[4:] for r in rows[law] if r[0] == kind and r[2] == reachable]) for law in rows}
            binding = np.array([r[3] for r in rows["default"] if r[0] == kind and r[2] == reachable])
            if not len(chosen["default"]):
                continue
            for law, found in chosen.items():
                ms = 1e3 * found[:, 0]
                print(
                    f"{kind:10s} {'reachable' if reachable else 'unreachable':12s} {law:24s} settling ms median "
                    f"{np.median(ms):6.2f} p95 {np.percentile(ms, 95):6.2f} max {ms.max():6.2f}; over "
                    f"{OVER:g} I_max {int((found[:, 1] > OVER).sum())} of {len(ms)}, most {found[:, 1].max():.3f}"
                )
            failed |= bool((chosen["default"][:, 1] > OVER).any())
            ms = 1e3 * chosen["default"][:, 0]
            failed |= not reachable and bool(np.percentile(ms, 95) > LATE_P95_MS or ms.max() > LATEST_MS)
            for law, other_law in (
                ("default", "no governor"),
                ("predictor", "predictor, no governor"),
                ("predictor", "default"),
            ):
                pairs = np.stack([chosen[law][:, 0], chosen[other_law][:, 0]], axis=1)
                text = "{:.3f} ({:.3f} to {:.3f})".format(*ratio(pairs))
                if reachable and binding.any():
                    text += "; voltage binds: {:.3f} ({:.3f} to {:.3f})".format(*ratio(pairs[binding]))
                print(f"    {law} / {other_law}: {text}")
                failed |= reachable and (law, other_law) == ("default", "no governor") and ratio(pairs)[2] > SLOWER
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
