# SPDX-License-Identifier: MIT
"""A second hand at the polar-coordinate laws: all six in numpy binary32, one operation at a time.

Written from the equations of reference ``polar-control.md`` in the core's order of operations, so that every result can
be compared bit for bit. Test code only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from tests.firmware.core_twin import PI, Twin, Vector, clamp, clarke, f, park, park_inverse, sincos

CONVENTIONAL, PROPOSED, LINEAR, PRINTED, REGULARISED, UNIFIED = range(1, 7)
ON_MEASUREMENT, NO_ANTI_WINDUP, PREDICT, SWITCH = 1, 2, 4, 8
ZERO, HALF, ONE, TWO = f(0), f(0.5), f(1), f(2)
ARCTAN = [
    f(x)
    for x in (
        0.99999989,
        -0.33332597,
        0.19985907,
        -0.14161229,
        0.10498946,
        -0.07234858,
        0.03978123,
        -0.01440136,
        0.00245673,
    )
]
FOLD, QUARTER = HALF * PI + f(0.2), HALF * PI
REACH = f(0.97)


def arctan(y: np.float32, x: np.float32) -> np.float32:
    size_x, size_y = abs(x), abs(y)
    large = max(size_x, size_y)
    if large <= 0:
        return ZERO
    t = min(size_x, size_y) / large
    z = t * t
    series = ARCTAN[-1]
    for term in reversed(ARCTAN[:-1]):
        series = term + z * series
    angle = t * series
    angle = angle if size_x > size_y else HALF * PI - angle
    return -angle if (y < 0) != (x < 0) else angle


def weight(x: np.float32) -> np.float32:
    return ONE - ONE / (ONE + x * (ONE + x * (HALF + x / f(6))))


def square(x: Vector) -> np.float32:
    return x[0] * x[0] + x[1] * x[1]


@dataclass
class Pid:
    """Memory of one PID: integral, low-passed input, last input."""

    integral: np.float32 = ZERO
    low: np.float32 = ZERO
    last: np.float32 = ZERO


@dataclass
class PolarTwin(Twin):
    """Polar laws of one drive in current mode, the unified one in torque mode as well."""

    delta: np.float32 = ZERO
    amplitude: np.float32 = ZERO
    phase_memory: Pid = field(default_factory=Pid)
    amplitude_memory: Pid = field(default_factory=Pid)
    charge: Vector = (ZERO, ZERO)
    short: Vector = (ZERO, ZERO)
    started: bool = False
    linear_on: bool = False
    disturbance: Vector = (ZERO, ZERO)
    committed: Vector = (ZERO, ZERO)
    before_voltage: Vector = (ZERO, ZERO)
    before: Vector = (ZERO, ZERO)

    def __post_init__(self) -> None:
        v: Mapping[str, float] = self.values
        self.mode, self.options = int(v["polar.mode"]), int(v["polar.options"])
        self.T_s = f(v["inverter.T_s_ns"]) * f(1e-9)
        self.R, self.psi = self["motor.R_s_ohm"], self["motor.psi_f_wb"]
        self.L = HALF * (self["motor.L_d_h"] + self["motor.L_q_h"])
        self.alpha = self.R / self.L

    # -- machine ---------------------------------------------------------------------------------------------

    def model_voltage(self, i: Vector) -> Vector:
        w = self.omega
        return (
            self.R * i[0] - w * self["motor.L_q_app_h"] * i[1],
            self.R * i[1] + w * (self["motor.L_d_app_h"] * i[0] + self.psi),
        )

    def observe(self, s: np.float32, c: np.float32, gain: np.float32) -> None:
        held = self.before_voltage if self["inverter.delay_periods"] >= 1 else self.committed
        sine, cosine = sincos(f(-0.5) * self.T_s * self.omega)
        u = park(held, s * cosine + c * sine, c * cosine - s * sine)
        mean = HALF * (self.i[0] + self.before[0]), HALF * (self.i[1] + self.before[1])
        model, rate = self.model_voltage(mean), ONE / self.T_s
        z = [
            u[k] - model[k] - self[f"motor.L_{axis}_h"] * ((self.i[k] - self.before[k]) * rate)
            for k, axis in enumerate("dq")
        ]
        d = self.disturbance
        self.disturbance = d[0] + gain * (z[0] - d[0]), d[1] + gain * (z[1] - d[1])

    def predict(self, s: np.float32, c: np.float32) -> Vector:
        u, i = park(self.committed, s, c), self.i
        psi = self["motor.L_d_app_h"] * i[0] + self.psi, self["motor.L_q_app_h"] * i[1]
        drop, lost = HALF * self.T_s * self.R, self.disturbance
        half, cosine_half = sincos(HALF * self.T_s * self.omega)
        sine, cosine = TWO * half * cosine_half, ONE - TWO * half * half
        fixed = (psi[0] + self.T_s * (u[0] - lost[0]) - drop * i[0], psi[1] + self.T_s * (u[1] - lost[1]) - drop * i[1])
        turned = park(fixed, sine, cosine)
        L = self["motor.L_d_h"], self["motor.L_q_h"]
        return (
            (L[0] * i[0] + (turned[0] - psi[0])) / (L[0] + drop),
            (L[1] * i[1] + (turned[1] - psi[1])) / (L[1] + drop),
        )

    # -- laws 1 and 2 ----------------------------------------------------------------------------------------

    def place(self, w: np.float32, sigma: np.float32, n1: np.float32, n0: np.float32) -> tuple[np.float32, ...]:
        w0 = self.alpha * self.alpha + w * w
        m = w0 if w0 > sigma * sigma else sigma * sigma
        c3 = f(4) * sigma - TWO * self.alpha
        c2 = f(4) * sigma * sigma + TWO * m - w0 - TWO * self.alpha * c3
        b0 = m * m / n0
        c1 = f(4) * sigma * m - n1 * b0 - w0 * c3
        k0 = n0 - TWO * self.alpha * n1
        det = k0 * n0 + w0 * n1 * n1
        b2, b1 = (c2 * n0 - n1 * c1) / det, (k0 * c1 + w0 * n1 * c2) / det
        a = c3 - n1 * b2
        if not a > 0:
            return ZERO, ZERO, ZERO, sigma
        K_i = b0 / a
        K_p = (b1 - K_i) / a
        return K_p, K_i, (b2 - K_p) / a, a

    def advance(
        self, gains: tuple[np.float32, ...], memory: Pid, e: np.float32, x: np.float32
    ) -> tuple[np.float32, Pid]:
        K_p, K_i, K_d, a = gains
        width, half = a * self.T_s, HALF * K_i * self.T_s * e
        low = ((TWO - width) * memory.low + width * (x + memory.last)) / (TWO + width)
        output = K_p * x + (memory.integral + half) + K_d * a * (x - low)
        return output, Pid(memory.integral + TWO * half, low, x)

    def share(self) -> np.float32:
        return f(0.35) if self.options & ON_MEASUREMENT else ONE

    def phase_start(self, v: Vector) -> None:
        mirror = f(-1) if self.omega < 0 else ONE
        size = np.sqrt(square(v))
        self.delta, self.amplitude = arctan(-v[0], mirror * v[1]), min(size, self.V)
        last = mirror * (self.share() * self.reference[1] - self.i[1])
        self.phase_memory = Pid(self.delta, last, last)
        self.amplitude_memory = Pid(self.amplitude, ZERO, ZERO)

    def plant(self, w: np.float32, i_q: np.float32, V_a: np.float32) -> tuple[np.float32, np.float32]:
        """Sine of the equilibrium's phase, and w cos - alpha sin."""
        X = w * self.L
        Z = np.sqrt(self.R * self.R + X * X)
        s = clamp((Z * Z * i_q + w * self.R * self.psi) / (V_a * Z), f(-0.98), f(0.98))
        c = np.sqrt(ONE - s * s)
        sine, cosine = (s * X - c * self.R) / Z, (c * X + s * self.R) / Z
        return sine, w * cosine - self.alpha * sine

    def phase_law(self) -> None:
        w, mirror = abs(self.omega), f(-1) if self.omega < 0 else ONE
        X = w * self.L
        power = self.R * self.R + X * X
        reach, emf = REACH * self.V * np.sqrt(power), w * self.R * self.psi
        i = self.i_model[0], mirror * self.i_model[1]
        q = clamp(mirror * self.reference[1], (-reach - emf) / power, (reach - emf) / power)
        free = bool(self.options & NO_ANTI_WINDUP)
        V_a, schedule, w_s = self.V, self.V, max(w, self.alpha)
        if self.mode == PROPOSED:
            schedule = max(self.amplitude, f(1e-3) * self.V)
            sine, lever = self.plant(w_s, q, schedule)
            gains = self.place(w_s, self["polar.sigma_amplitude_rad_s"], -sine / self.L, lever / self.L)
            e = self.reference[0] - i[0]
            output, kept = self.advance(gains, self.amplitude_memory, e, e)
            V_a = clamp(output, ZERO, self.V)
            self.amplitude_memory = kept if V_a == output or free else self.amplitude_memory
        sine, lever = self.plant(w_s, q, schedule)
        scale = schedule / self.L
        gains = self.place(w_s, self["polar.sigma_phase_rad_s"], -scale * sine, scale * lever)
        output, kept = self.advance(gains, self.phase_memory, q - i[1], self.share() * q - i[1])
        delta = clamp(output, -QUARTER, QUARTER)
        self.phase_memory = kept if delta == output or free else self.phase_memory
        sine, cosine = sincos(delta)
        self.u = -V_a * sine, mirror * V_a * cosine
        self.delta, self.amplitude = delta, V_a

    # -- laws 3 to 5 -----------------------------------------------------------------------------------------

    def cdm(self, tau: np.float32, L: np.float32) -> tuple[np.float32, np.float32]:
        a1 = self["polar.gamma"] / tau
        K_p = a1 * L - self.R
        return max(K_p, ZERO), a1 / tau * L

    def decoupling(self) -> np.float32:
        i = self.i_model
        if self.omega == 0:
            return ZERO
        if self.mode == PRINTED:
            return arctan(self.omega * self.L * i[1], self.omega * self.L * i[0] + self.psi)
        return arctan(self.L * i[1], self.L * i[0] + self.psi)

    def linear(self) -> None:
        i, tau, free = self.i_model, self["polar.tau_s"], bool(self.options & NO_ANTI_WINDUP)
        e = self.reference[0] - i[0], self.reference[1] - i[1]
        psi = self.L * i[0] + self.psi, self.L * i[1]
        _, cosine = sincos(clamp(self.delta, f(-0.45) * PI, f(0.45) * PI))
        x_d, x_q = self.charge
        K_p, K_i = self.cdm(tau, self.L)
        raw = self.omega * np.sqrt(square(psi)) + (K_p * e[1] + x_q) / cosine
        V_a = clamp(raw, -self.V, self.V)
        x_q = x_q + (K_i * self.T_s * e[1] if abs(raw) <= self.V or free else ZERO)
        least = f(1e-3) * self.V
        V_o = (-least if V_a > -least else V_a) if V_a < 0 else max(V_a, least)
        grip, slow = abs(V_o * cosine), f(0.01) * self.V
        K_p, K_i = self.cdm(tau * slow / grip if grip < slow else tau, self.L)
        raw = self.decoupling() - (K_p * e[0] / (V_o * cosine)) + x_d
        delta = clamp(raw, -QUARTER, QUARTER)
        x_d = x_d - (K_i * self.T_s * e[0] / (V_o * cosine) if abs(raw) <= QUARTER or free else ZERO)
        sine, cosine = sincos(delta)
        self.u, self.charge = (-V_a * sine, V_a * cosine), (x_d, x_q)
        self.delta, self.amplitude = delta, V_a

    def polar_map(self, v: Vector) -> None:
        eps, delta = self["polar.eps_ratio"] * self.V, self.delta
        sine, cosine = sincos(delta)
        along, across = cosine * v[1] - sine * v[0], -(cosine * v[0] + sine * v[1])
        power, floor = square(v) * square(v), (eps * eps) * (eps * eps)
        if power > 0:
            delta = delta + arctan(across, along) * (power / (power + floor))
        delta = delta - PI if delta > FOLD else delta + PI if delta < -FOLD else delta
        sine, cosine = sincos(delta)
        V_a = cosine * v[1] - sine * v[0]
        self.u = -V_a * sine, V_a * cosine
        self.delta, self.amplitude = delta, V_a

    def regularised_base(self) -> Vector:
        b, i, r, model = self["polar.b"], self.i_model, self.reference, self.model_voltage(self.i_model)
        tau = self["polar.tau_s"]
        K = self.cdm(tau, self["motor.L_d_h"])[0], self.cdm(tau, self["motor.L_q_h"])[0]
        return (
            K[0] * (b * r[0] - i[0]) + (model[0] - self.R * i[0]),
            K[1] * (b * r[1] - i[1]) + (model[1] - self.R * i[1]),
        )

    def integrate(self) -> None:
        x = [*self.charge]
        for k, axis in enumerate("dq"):
            K_i = self.cdm(self["polar.tau_s"], self[f"motor.L_{axis}_h"])[1]
            x[k] = x[k] + K_i * self.T_s * (self.reference[k] - self.i[k])
        self.charge = x[0], x[1]

    @property
    def ahead(self) -> bool:
        return bool(self.options & PREDICT and self["inverter.delay_periods"] >= 1)

    def regularised(self) -> None:
        if self.ahead:
            self.integrate()
        base = self.regularised_base()
        self.polar_map((base[0] + self.charge[0], base[1] + self.charge[1]))

    def regularised_settle(self, realised: Vector) -> None:
        base, x = self.regularised_base(), [*self.charge]
        for k, axis in enumerate("dq"):
            K_p, K_i = self.cdm(self["polar.tau_s"], self[f"motor.L_{axis}_h"])
            cut = realised[k] - (base[k] + x[k])
            x[k] = x[k] + K_i * self.T_s * (cut / K_p)
        self.charge = x[0], x[1]
        if not self.ahead:
            self.integrate()

    def holding(self, i: Vector) -> Vector:
        v = self.model_voltage(i)
        return v[0] + self.disturbance[0], v[1] + self.disturbance[1]

    def charge_from(self, v: Vector) -> None:
        base = self.regularised_base()
        self.charge = v[0] - base[0], v[1] - base[1]

    def takes_linear(self, s: np.float32, c: np.float32) -> bool:
        self.observe(s, c, weight(self["polar.omega_dob_rad_s"] * self.T_s))
        fits = square(self.holding(self.reference)) <= self.V * self.V
        base = self.regularised_base()
        if self.linear_on:
            if fits or square((base[0] + self.charge[0], base[1] + self.charge[1])) <= self.V * self.V:
                return True
            self.phase_start(self.holding(self.i_model))
            self.linear_on = False
            return False
        if not fits or self.i_model[0] < self.reference[0]:
            return False
        v = self.holding(self.i_model)
        self.charge_from(v)
        self.delta, self.linear_on = arctan(-v[0], v[1]), True
        return True

    # -- law 6 -----------------------------------------------------------------------------------------------

    def steady(self, i: Vector) -> Vector:
        v = self.model_voltage(i)
        return (v[0] + (self.disturbance[0] + self.short[0]), v[1] + (self.disturbance[1] + self.short[1]))

    def on_circle(self, i_q: np.float32, V: np.float32) -> tuple[Vector, np.float32]:
        R, X_d, X_q, E = self.R, *self.X, self.E
        a, slope, offset = R * R + X_d * X_d, R * R + X_d * X_q, R * E[1] - X_d * E[0]
        inverse, power = ONE / a, a * V * V
        reach, level = REACH * np.sqrt(power), slope * i_q + offset
        cut = clamp(level, -reach, reach)
        q = i_q if cut == level else (cut - offset) / slope
        b_0, b_1, root = R * E[0] + X_d * E[1], R * (X_d - X_q), np.sqrt(power - cut * cut)
        return ((root - (b_0 + b_1 * q)) * inverse, q), -(b_1 + cut * slope / root) * inverse

    def at_i_d(self, i_d: np.float32, sign: np.float32, V: np.float32) -> Vector | None:
        v = self.R * i_d + self.E[0], self.X[0] * i_d + self.E[1]
        power, half = self.R * self.R + self.X[1] * self.X[1], self.R * v[1] - self.X[1] * v[0]
        D = half * half - power * (v[0] * v[0] + v[1] * v[1] - V * V)
        if D < 0:
            return None
        root = np.sqrt(D)
        return i_d, ((-root if sign < 0 else root) - half) / power

    def hold_torque(self, i_q: np.float32, V: np.float32) -> Vector:
        saliency = self["motor.L_d_app_h"] - self["motor.L_q_app_h"]
        i, slope = self.on_circle(i_q, V)
        if saliency == 0 or not self.torque_mode:
            return i
        asked = (self.psi + saliency * self.reference[0]) * self.reference[1]
        for _ in range(2):
            flux = self.psi + saliency * i[0]
            gradient = flux + saliency * slope * i[1]
            if gradient <= 0:
                break
            i, slope = self.on_circle(i[1] - (flux * i[1] - asked) / gradient, V)
        return i

    def within_limit(self, i: Vector, V: np.float32) -> Vector:
        limit = self["motor.I_max_apk"]
        if square(i) <= limit * limit:
            return i
        i, slope = self.on_circle(i[1], V)
        for _ in range(3):
            gradient = TWO * (i[0] * slope + i[1])
            if gradient * i[1] <= 0:
                break
            i, slope = self.on_circle(i[1] - (square(i) - limit * limit) / gradient, V)
        self.flags |= 4
        return i

    def find_point(self, V: np.float32) -> tuple[Vector, Vector, bool]:
        wanted = self.reference
        v = self.steady(wanted)
        if square(v) <= V * V:
            return wanted, v, False
        self.X = self.omega * self["motor.L_d_app_h"], self.omega * self["motor.L_q_app_h"]
        self.E = self.steady((ZERO, ZERO))
        i = self.within_limit(self.hold_torque(wanted[1], V), V)
        least = self["field_weakening.i_d_min_a"]
        if i[0] > wanted[0]:
            i = self.at_i_d(wanted[0], wanted[1], V) or i
        elif i[0] < least:
            other = self.at_i_d(least, wanted[1], V)
            i, self.flags = (i, self.flags) if other is None else (other, self.flags | 4)
        return i, self.steady(i), True

    def unified(self, s: np.float32, c: np.float32) -> None:
        self.observe(s, c, weight(self["polar.omega_dob_rad_s"] * self.T_s))
        i_o, v_o, weakened = self.find_point(min(self["polar.V_ref_ratio"] * self.V_max, self.V))
        L, w, w_c = (self["motor.L_d_h"], self["motor.L_q_h"]), self.omega, self["polar.omega_c_rad_s"]
        e = i_o[0] - self.i_model[0], i_o[1] - self.i_model[1]
        v = (
            v_o[0] + L[0] * w_c * e[0] + w * self["motor.L_q_app_h"] * e[1],
            v_o[1] + L[1] * w_c * e[1] - w * self["motor.L_d_app_h"] * e[0],
        )
        if weakened and square(v) > self.V * self.V:
            w_f = TWO * abs(w)
            v = v_o[0] + L[0] * w_f * e[0], v_o[1] + L[1] * w_f * e[1]
            size = np.sqrt(square(v))
            v = (v[0] * (self.V / size), v[1] * (self.V / size)) if size > 0 else v
        self.reference = i_o
        self.polar_map(v)

    def unified_settle(self, realised: Vector) -> None:
        gain, cut = weight(self["polar.omega_dob_rad_s"] * self.T_s), (ZERO, ZERO)
        if self.flags & 2:
            size = np.sqrt(square(self.u))
            share = self.V / size if size > self.V else ONE
            cut = share * self.u[0] - realised[0], share * self.u[1] - realised[1]
        x = self.short
        self.short = x[0] + gain * (cut[0] - x[0]), x[1] + gain * (cut[1] - x[1])

    # -- one period ------------------------------------------------------------------------------------------

    def start(self) -> None:
        self.started = self.linear_on = True
        v = self.model_voltage(self.i_model)
        if self.mode in (CONVENTIONAL, PROPOSED):
            self.phase_start(v)
        if self.mode == REGULARISED or self.options & SWITCH:
            self.charge_from(v)
            self.delta = arctan(-v[0], v[1])

    def demand_polar(self, s: np.float32, c: np.float32) -> bool:
        """Set the demand; True where the regularised law stands in for the phase law."""
        if not self.started:
            self.start()
        if self.mode == UNIFIED:
            self.unified(s, c)
        elif self.mode == REGULARISED:
            self.regularised()
        elif self.mode in (LINEAR, PRINTED):
            self.linear()
        elif self.options & SWITCH and self.takes_linear(s, c):
            self.regularised()
            return True
        else:
            self.phase_law()
        return False

    def direct_current(self, tau: np.float32) -> Vector:
        """The current of a torque without field weakening by tables or optimisation."""
        i_d = self["field_weakening.i_d_lm_a"]
        saliency = self["motor.L_d_app_h"] - self["motor.L_q_app_h"]
        return i_d, tau / (f(1.5) * f(self.values["motor.pole_pairs"]) * (self.psi + saliency * i_d))

    def period(
        self,
        phases: tuple,
        theta: np.float32,
        omega: np.float32,
        U_dc: np.float32,
        request: Vector | None = None,
        tau: np.float32 | None = None,
    ) -> tuple:
        """One period: duties, demanded and realised voltage."""
        self.torque_mode = tau is not None
        if tau is not None:
            request = self.direct_current(tau)
        assert request is not None
        self.flags, self.omega = 0, omega
        s, c = sincos(theta)
        s_out, c_out = sincos(theta + self["inverter.delay_periods"] * self.T_s * omega)
        self.i = park(clarke(*phases), s, c)
        self.reference = self.limit_current(request)
        self.V_max = self["inverter.voltage_utilisation"] * U_dc
        self.V = self["polar.V_a_max_ratio"] * self.V_max
        self.i_model = self.predict(s, c) if self.ahead else self.i
        stands_in = self.demand_polar(s, c)
        realised = self.limit_voltage(self.u, self.V)
        stator = park_inverse(realised, s_out, c_out)
        duties, clipped = self.duties(stator, U_dc)
        if clipped:
            self.flags |= 2
            stator = clarke(*(U_dc * d for d in duties))
            realised = park(stator, s_out, c_out)
        if self.mode == REGULARISED or stands_in:
            self.regularised_settle(realised)
        elif self.mode == UNIFIED:
            self.unified_settle(realised)
        self.before_voltage, self.committed, self.before = self.committed, stator, self.i
        return duties, self.u, realised
