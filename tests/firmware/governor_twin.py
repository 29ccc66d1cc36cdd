# SPDX-License-Identifier: MIT
"""A second hand at the reference governor: rows, projections, line search, minimum-time direction in numpy binary32.

One operation at a time in the core's order, so that the governed reference can be compared bit for bit. Test code only.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from tests.firmware.closed_loop import BEST, CURRENT_ROW, LINE, MINIMUM_TIME, PAPER, PRE_PROJECTION
from tests.firmware.core_twin import Twin, Vector, clarke, f, park, park_inverse, sincos
from tests.firmware.projection_twin import (
    HALF,
    NONE,
    ONE,
    TWO,
    ZERO,
    Row,
    find_corner,
    project_pair,
    project_row,
    project_row_from,
    project_rows,
    row_share,
    scale_voltage,
    smallest_voltage,
    square,
)

EMPTY, STEERED = 254, 250
EMPTY_MARGIN, HOLD_SHARE, LANDING_REST, ACCURACY, CLOSE_SHARE = f(1.00001), f(0.99), f(0.26), f(1e-2), f(0.95)
LANDING_PERIODS = f(6)
STILL_SHARE, MODEL_SHARE = f(0.2), f(0.1)
MEAN_WEIGHT, SURE_SHARE, SLOW_GAIN, NEAR_SHARE = f(0.05), f(0.01), f(0.1), f(0.2)
SHRINK, FORCED, FASTER = f(0.85), f(1.2), f(1.4)
TRIALS, INSIDE = 2, f(0.9999995)
FLAG_FALLBACK = 64
TRIES, FOUND = 6, 255


@dataclass
class GovernedTwin(Twin):
    """Current control of one drive with its governor (modes paper, line search and best; circle limit)."""

    held: Vector = (ZERO, ZERO)
    before: Vector = (ZERO, ZERO)
    committed: Vector = (ZERO, ZERO)
    disturbance: Vector = (ZERO, ZERO)
    time_to_go: np.float32 = ZERO
    landing: bool = False
    news: list[np.float32] = field(default_factory=lambda: [ZERO, ZERO])
    mean: list[np.float32] = field(default_factory=lambda: [ZERO, ZERO])
    off_model: bool = False
    u: Vector = (ZERO, ZERO)
    reachable: Vector | None = None
    multiplier: np.float32 = ZERO
    corner: Vector = (ZERO, ZERO)
    cornered: int = 0
    projected: bool = False
    omega: np.float32 = ZERO
    T_s: np.float32 = ZERO
    V_max: np.float32 = ZERO
    i: Vector = (ZERO, ZERO)
    binding: int = field(default=NONE)

    @property
    def observed(self) -> bool:
        return int(self.values["governor.mode"]) == BEST and self.values["governor.observer_gain"] > 0

    def model_voltage(self, i: Vector) -> Vector:
        return (
            self["motor.R_s_ohm"] * i[0] - self.omega * self["motor.L_q_app_h"] * i[1],
            self["motor.R_s_ohm"] * i[1] + self.omega * (self["motor.L_d_app_h"] * i[0] + self["motor.psi_f_wb"]),
        )

    def observe(self, s: np.float32, c: np.float32) -> None:
        sine, cosine = sincos(f(-0.5) * self.T_s * self.omega)
        u = park(self.committed, s * cosine + c * sine, c * cosine - s * sine)
        mean = HALF * (self.i[0] + self.before[0]), HALF * (self.i[1] + self.before[1])
        model, rate = self.model_voltage(mean), ONE / self.T_s
        inductive = [self[f"motor.L_{axis}_h"] * ((self.i[k] - self.before[k]) * rate) for k, axis in enumerate("dq")]
        d, before, power = self.disturbance, self.news, self.V_max * self.V_max
        self.news = news = [u[k] - model[k] - inductive[k] - d[k] for k in range(2)]
        self.mean = [m + MEAN_WEIGHT * (x - m) for m, x in zip(self.mean, news, strict=True)]
        lasting = square((self.mean[0], self.mean[1])) / (SURE_SHARE * SURE_SHARE * power)
        gain = self["governor.observer_gain"] * min(max(lasting, SLOW_GAIN), ONE)
        if square((inductive[0], inductive[1])) <= STILL_SHARE * STILL_SHARE * power:
            agreed = [ZERO if a * b <= 0 else (a if abs(a) < abs(b) else b) for a, b in zip(news, before, strict=True)]
            self.disturbance = d[0] + gain * agreed[0], d[1] + gain * agreed[1]
        self.off_model = bool(square((news[0], news[1])) > MODEL_SHARE * MODEL_SHARE * power)

    def rows(self) -> tuple[list[Row], int, Vector]:
        """All rows, the index of the steady-state one, and the voltage beside the model."""
        u0 = self.demand((ZERO - self.i[0], ZERO - self.i[1]), self.i, self.omega)
        K = self["current.K_p_d_v_per_a"], self["current.K_p_q_v_per_a"]
        rows = [Row(K[0], ZERO, ZERO, K[1], u0, self.V_max)]
        offset: Vector = (ZERO, ZERO)
        if int(self.values["governor.mode"]) == PAPER:
            rows += self.prediction(int(self.values["governor.k_max"]))
        elif self.observed:
            offset = self.disturbance
        else:
            hold, model = rows[0].voltage(self.i), self.model_voltage(self.i)
            offset = hold[0] - model[0], hold[1] - model[1]
        R, w = self["motor.R_s_ohm"], self.omega
        rows.append(
            Row(
                R,
                -w * self["motor.L_q_app_h"],
                w * self["motor.L_d_app_h"],
                R,
                (offset[0], offset[1] + w * self["motor.psi_f_wb"]),
                (ONE - self["governor.eps"]) * self.V_max,
            )
        )
        steady = len(rows) - 1
        if int(self.values["governor.options"]) & CURRENT_ROW:
            rows.append(Row(ONE, ZERO, ZERO, ONE, (ZERO, ZERO), self["governor.I_transient_apk"]))
        return rows, steady, offset

    def prediction(self, k_max: int) -> list[Row]:
        w, R, rows = self.omega, self["motor.R_s_ohm"], []
        X = w * self["motor.L_d_app_h"], w * self["motor.L_q_app_h"]
        emf = w * self["motor.psi_f_wb"]
        K = self["current.K_p_d_v_per_a"], self["current.K_p_q_v_per_a"]
        K_iT = [self.T_s * self[f"current.K_i_{axis}_v_per_as"] for axis in "dq"]
        T_L = [self.T_s / self[f"motor.L_{axis}_h"] for axis in "dq"]
        i, x, i1, x1 = [*self.i], [*self.x], [ZERO, ZERO], [ZERO, ZERO]
        for _ in range(k_max):
            for k in range(2):
                u, u1 = x[k] - K[k] * i[k], K[k] * (ONE - i1[k]) + x1[k]
                x[k] = x[k] - K_iT[k] * i[k]
                i[k] = i[k] + T_L[k] * (u - R * i[k])
                x1[k] = x1[k] + K_iT[k] * (ONE - i1[k])
                i1[k] = i1[k] + T_L[k] * (u1 - R * i1[k])
            rows.append(
                Row(
                    K[0] * (ONE - i1[0]) + x1[0],
                    -X[1] * i1[1],
                    X[0] * i1[0],
                    K[1] * (ONE - i1[1]) + x1[1],
                    ((x[0] - K[0] * i[0]) - X[1] * i[1], (x[1] - K[1] * i[1]) + X[0] * i[0] + emf),
                    self.V_max,
                )
            )
        return rows

    def admits(self, rows: list[Row], steady: int, r: Vector) -> bool:
        """Row 0, steady state and current as rows; in between the demand along the trajectory of the request."""
        if not all(square(row.voltage(r)) <= row.V * row.V for row in (rows[0], *rows[steady:])):
            return False
        w, R = self.omega, self["motor.R_s_ohm"]
        X, emf = (w * self["motor.L_d_app_h"], w * self["motor.L_q_app_h"]), w * self["motor.psi_f_wb"]
        K = self["current.K_p_d_v_per_a"], self["current.K_p_q_v_per_a"]
        K_iT = [self.T_s * self[f"current.K_i_{axis}_v_per_as"] for axis in "dq"]
        T_L = [self.T_s / self[f"motor.L_{axis}_h"] for axis in "dq"]
        i, x = [*self.i], [*self.x]
        u = [K[k] * (r[k] - i[k]) + x[k] for k in range(2)]
        for _ in range(steady - 1):
            for k in range(2):
                following = x[k] + K_iT[k] * (r[k] - i[k])
                i[k] = i[k] + T_L[k] * (u[k] - R * i[k])
                x[k] = following
                u[k] = K[k] * (r[k] - i[k]) + following
            if square((u[0] - X[1] * i[1], u[1] + (X[0] * i[0] + emf))) > self.V_max * self.V_max:
                return False
        return True

    def line_search(self, rows: list[Row], steady: int, r: Vector) -> tuple[Vector, int]:
        p = self.held
        way = r[0] - p[0], r[1] - p[1]
        kappa, active = ONE, NONE
        for k, row in enumerate(rows):
            share = row_share(row, p, way, self["governor.slack"])
            self.flags |= FLAG_FALLBACK if share < 0 else 0
            if share < kappa and (k <= steady or share >= 0):
                kappa, active = share, k
            if kappa < 0:
                break
        if kappa >= 0:
            return (p[0] + kappa * way[0], p[1] + kappa * way[1]), active
        last = rows[steady]
        return (scale_voltage(last, p) if square(last.voltage(p)) > last.V * last.V else p), active

    def solve(self, rows: list[Row], steady: int, r: Vector) -> tuple[Vector, int]:
        if int(self.values["governor.mode"]) == LINE:
            return self.line_search(rows, steady, r)
        found = project_rows(rows[: steady + 1], r)
        if found is not None and self.projected and len(rows) > steady + 1:
            v, basis = found
            return (self.slide(rows, r, v) if basis[1] == NONE else v), basis[0]
        more = None if found is None else project_rows(rows, r, found)
        self.flags |= FLAG_FALLBACK if more is None else 0
        if found is None:
            return smallest_voltage(rows[steady], rows[0]), EMPTY
        v, basis = found if more is None else more
        return v, basis[0]

    def approach(self, rows: list[Row], steady: int, r: Vector) -> Vector:
        """The reachable request of the line search: steady-state row and corner with the current row in turn."""
        last, kept = rows[steady], self.reachable
        pre, self.reachable = Row(last.dd, last.dq, last.qd, last.qq, last.c, last.V * f(0.99999)), None
        if kept is not None:
            self.corner, found = find_corner(rows[-1], pre, r, self.corner, 1)
            self.cornered = FOUND if found else self.cornered + 1 if self.cornered < TRIES else 0
            return self.corner if found else kept
        v, self.multiplier = project_row_from(pre, r, self.multiplier, 2)
        if len(rows) <= steady + 1 or square(v) <= rows[-1].V * rows[-1].V:
            self.cornered = 0
            return v
        if self.cornered == 0:
            share = rows[-1].V / np.sqrt(square(v))
            self.corner = share * v[0], share * v[1]
        self.reachable = v
        return self.corner if self.cornered == FOUND else v

    def pre_project(self, rows: list[Row], steady: int, r: Vector) -> tuple[Vector, bool]:
        """The reachable request, and whether the period has time left to start a transfer."""
        last, kept = rows[steady], self.reachable
        pre = Row(last.dd, last.dq, last.qd, last.qq, last.c, last.V * f(0.99999))
        v = project_row(pre, r)
        self.reachable = None
        if len(rows) <= steady + 1 or square(v) <= rows[-1].V * rows[-1].V:
            return v, True
        if kept is not None and self.time_to_go <= 0:
            return kept, True
        self.reachable = v = self.meet_both(pre, rows[-1], r, v)
        return v, False

    @staticmethod
    def slide(rows: list[Row], r: Vector, v: Vector) -> Vector:
        """The corner of row 0 and current row beside a point of row 0 that is outside the other."""
        now, last = rows[0], replace(rows[-1], V=rows[-1].V * f(1.02))
        limit, power = last.V * last.V, square(v)
        if power <= limit:
            return v
        share = last.V / np.sqrt(power)
        corner, _ = find_corner(now, last, r, (share * v[0], share * v[1]), 3)
        margin = f(1.0001)
        within = square(corner) <= margin * limit and square(now.voltage(corner)) <= margin * now.V * now.V
        return corner if within else v

    @staticmethod
    def meet_both(row: Row, circle: Row, r: Vector, v: Vector) -> Vector:
        """The nearest point inside a row and the circle, which v, nearest on the row alone, is not."""
        power, outside = square(r), v
        inside = power <= circle.V * circle.V
        if not inside:
            share = circle.V / np.sqrt(power)
            outside = share * r[0], share * r[1]
            if square(row.voltage(outside)) <= row.V * row.V:
                return outside
        first, second = (row, circle) if inside else (circle, row)
        corner, found = project_pair(first, second, r, outside, smallest_voltage(second, first))
        return corner if corner is not None and found else v

    def govern(self, request: Vector) -> Vector:
        options, r, may_start = int(self.values["governor.options"]), request, True
        rows, steady, offset = self.rows()
        self.projected = bool(options & PRE_PROJECTION) and int(self.values["governor.mode"]) != LINE
        if options & PRE_PROJECTION:
            if int(self.values["governor.mode"]) == LINE:
                r = self.approach(rows, steady, r)
            else:
                r, may_start = self.pre_project(rows, steady, r)
        asks_first = int(self.values["governor.mode"]) in (PAPER, BEST)
        self.binding = NONE
        if asks_first and self.admits(rows, steady, r):
            v = self.land(rows[0], r)
        elif asks_first and options & MINIMUM_TIME:
            v = self.steer(rows, steady, offset, r, may_start)
        else:
            v, self.binding = self.solve(rows, steady, r)
        w = rows[0].voltage(v)
        power = square(w)
        self.u = w
        if power > self.V_max * self.V_max:
            share = ONE - INSIDE * self.V_max / np.sqrt(power)
            over = share * w[0], share * w[1]
            self.u = w[0] - over[0], w[1] - over[1]
            v = v[0] - over[0] / rows[0].dd, v[1] - over[1] / rows[0].qq
        if v[0] != request[0] or v[1] != request[1]:
            self.flags |= 32
        return v

    def land(self, now: Row, r: Vector) -> Vector:
        landing, left = self.landing, self.time_to_go
        self.landing, self.time_to_go = False, ZERO
        if not landing or self.off_model:
            return r
        out = []
        for k, axis in enumerate("dq"):
            gain = (ONE - LANDING_REST) * self[f"motor.L_{axis}_h"] / ((now.dd, now.qq)[k] * self.T_s)
            out.append(self.i[k] + gain * (r[k] - self.i[k]) if gain > 1 else r[k])
        if left > LANDING_PERIODS * self.T_s and square(now.voltage((out[0], out[1]))) > now.V * now.V:
            return r
        self.binding = STEERED
        return out[0], out[1]

    def steer(self, rows: list[Row], steady: int, offset: Vector, r: Vector, may_start: bool) -> Vector:
        last = rows[steady]
        steered, barred = self.minimum_time(rows[0], offset, r, may_start)
        if steered is not None:
            self.landing, self.binding = True, STEERED
            return steered
        if not barred and not self.time_to_go > 0 and may_start:
            v, self.binding = self.solve(rows, steady, r)
            return v
        v = smallest_voltage(last, rows[0])
        empty = bool(square(last.voltage(v)) > EMPTY_MARGIN * last.V * last.V)
        self.flags |= FLAG_FALLBACK if empty else 0
        if empty or (barred and square(last.voltage(self.i)) > self.V_max * self.V_max):
            self.binding = EMPTY
            return v
        self.binding = 0
        v = project_row(rows[0], r)
        return self.slide(rows, r, v) if len(rows) > steady + 1 else v

    def at_time(self, T: np.float32, a: Vector, b: Vector, drops: tuple[Vector, Vector]) -> tuple:
        """Way, its rate, gap, the slope of the gap times the way's length, and that length after time T."""
        s, c = sincos(self.omega * T)
        turned = c * b[0] - s * b[1], s * b[0] + c * b[1]
        drop = (drops[0][0] + c * drops[1][0] - s * drops[1][1], drops[0][1] + s * drops[1][0] + c * drops[1][1])
        m = turned[0] - a[0] + drop[0] * T, turned[1] - a[1] + drop[1] * T
        rate = drop[0] - self.omega * turned[1], drop[1] + self.omega * turned[0]
        size = np.sqrt(square(m))
        return m, rate, size - self.V_max * T, (m[0] * rate[0] + m[1] * rate[1]) - self.V_max * size, size

    def find_time(self, way: tuple, T: np.float32, least: np.float32) -> tuple[np.float32, Vector | None]:
        """Time and way of the transfer; without a way the time to go on from, 0 when there is no transfer."""
        low, high, w = ZERO, ZERO, abs(self.omega)
        for _ in range(TRIALS):
            if T * w > f(100):
                break
            m, rate, gap, slope, size = self.at_time(T, *way)
            if slope < 0 and abs(gap) <= ACCURACY * self.V_max * T:
                last = -gap * size / slope
                T = T + last
                return (T, (m[0] + last * rate[0], m[1] + last * rate[1])) if T > least else (ZERO, None)
            low, high = (T, high) if gap > 0 else (low, T)
            if gap <= 0 and high <= least:
                return ZERO, None
            step = ONE * T
            if slope < 0:
                step = -gap * size / slope
                step = ONE / w if step * w > ONE else step
            following = T + step
            T = HALF * (low + high) if following <= low or (high > 0 and following >= high) else following
        return (T if T * w <= f(100) else ZERO), None

    def minimum_time(self, now: Row, offset: Vector, target: Vector, may_start: bool) -> tuple[Vector | None, bool]:
        """The steering reference, and whether a transfer was found that the transient current limit bars."""
        R, least = self["motor.R_s_ohm"], f(3) * self.T_s
        a, b = (
            (self["motor.psi_f_wb"] + self["motor.L_d_app_h"] * x[0], self["motor.L_q_app_h"] * x[1])
            for x in (self.i, target)
        )
        direct = square((b[0] - a[0], b[1] - a[1]))
        near = NEAR_SHARE * self.V_max * self.T_s
        if direct <= near * near:
            self.time_to_go = ZERO
            return None, False
        drops = tuple((HALF * (R * x[0] + offset[0]), HALF * (R * x[1] + offset[1])) for x in (self.i, target))
        T, m = self.time_to_go - self.T_s, None
        if T > 0:
            T, m = self.find_time((a, b, drops), T, least)
        elif may_start and not self.is_cornered(offset):
            T, m = self.find_time((a, b, drops), max(f(0.7) * np.sqrt(direct) / self.V_max, least), least)
        else:
            T = ZERO
        self.time_to_go = T if m is None else ZERO
        if m is None:
            return None, False
        s, c = sincos(HALF * self.T_s * self.omega)
        w, scale = park(m, s, c), self.V_max / np.sqrt(square(m))
        w = w[0] * scale, w[1] * scale
        kept = self.keep_current(offset, w)
        if kept is None:
            return None, True
        self.time_to_go = T
        return ((kept[0] - now.c[0]) / now.dd, (kept[1] - now.c[1]) / now.qq), False

    def is_cornered(self, offset: Vector) -> bool:
        model, limit, power = (
            self.model_voltage(self.i),
            CLOSE_SHARE * self["governor.I_transient_apk"],
            self.V_max * self.V_max,
        )
        hold = square((model[0] + offset[0], model[1] + offset[1]))
        return bool(square(self.i) > limit * limit and HOLD_SHARE * HOLD_SHARE * power < hold <= power)

    def keep_current(self, offset: Vector, w: Vector) -> Vector | None:
        model, i = self.model_voltage(self.i), self.i
        per = FASTER * self.T_s / self["motor.L_d_h"], FASTER * self.T_s / self["motor.L_q_h"]
        hold = model[0] + offset[0], model[1] + offset[1]
        free = i[0] - per[0] * hold[0], i[1] - per[1] * hold[1]
        limit, now = self["governor.I_transient_apk"], square(i)
        bound = max(SHRINK * now, limit * limit) if now <= FORCED * (limit * limit) else now
        step = per[0] * w[0], per[1] * w[1]
        if square((free[0] + step[0], free[1] + step[1])) <= bound:
            return w
        if square(hold) > HOLD_SHARE * HOLD_SHARE * self.V_max * self.V_max:
            return None
        g = TWO * per[0] * free[0], TWO * per[1] * free[1]
        gg, power = square(g), square(w)
        side = f(-1) if g[0] * w[1] - g[1] * w[0] < 0 else ONE
        for _ in range(2):
            along = (bound - square(free) - square(step)) / gg
            across = power / gg - along * along
            if not across >= 0:
                return None
            root = side * np.sqrt(across)
            w = along * g[0] - root * g[1], along * g[1] + root * g[0]
            step = per[0] * w[0], per[1] * w[1]
        return w

    def period(self, phases: tuple, theta: np.float32, omega: np.float32, U_dc: np.float32, request: Vector) -> tuple:
        """One governed period without computation delay: governed reference, duties, realised voltage."""
        self.flags, self.omega = 0, omega
        self.T_s = f(self.values["inverter.T_s_ns"]) * f(1e-9)
        self.V_max = self["inverter.voltage_utilisation"] * U_dc
        s, c = sincos(theta)
        s_out, c_out = sincos(theta + self["inverter.delay_periods"] * self.T_s * omega)
        self.i = i = park(clarke(*phases), s, c)
        request = self.limit_current(request)
        if self.observed:
            self.observe(s, c)
        v = self.govern(request)
        u = self.u
        realised = self.limit_voltage(u, self.V_max)
        stator = park_inverse(realised, s_out, c_out)
        duties, clipped = self.duties(stator, U_dc)
        if clipped:
            self.flags |= 2
            stator = clarke(*(U_dc * d for d in duties))
            realised = park(stator, s_out, c_out)
        self.integrate(v, i, u, realised)
        self.held, self.before, self.committed = v, i, stator
        return v, duties, realised
