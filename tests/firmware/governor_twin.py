"""A second hand at the reference governor: rows, projections, line search, minimum-time direction in numpy binary32.

One operation at a time in the core's order, so that the governed reference can be compared bit for bit. Test code only.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tests.firmware.closed_loop import BEST, CURRENT_ROW, LINE, MINIMUM_TIME, PAPER, PRE_PROJECTION
from tests.firmware.core_twin import Twin, Vector, clarke, f, park, park_inverse, sincos

ROW_TOLERANCE, PAIR_TOLERANCE, VIOLATION, STALL = f(1e-6), f(2e-6), f(5e-6), f(2e-5)
SINGULAR, ROUNDING = f(1e-6), f(3e-7)
ROUNDS, PAIR_STEPS, NONE, EMPTY, STEERED = 16, 16, 255, 254, 250
ZERO, ONE, TWO, HALF = f(0), f(1), f(2), f(0.5)


@dataclass(frozen=True)
class Row:
    dd: np.float32
    dq: np.float32
    qd: np.float32
    qq: np.float32
    c: Vector
    V: np.float32

    def voltage(self, v: Vector) -> Vector:
        return (self.dd * v[0] + self.dq * v[1]) + self.c[0], (self.qd * v[0] + self.qq * v[1]) + self.c[1]

    def transposed(self, w: Vector) -> Vector:
        return self.dd * w[0] + self.qd * w[1], self.dq * w[0] + self.qq * w[1]

    def excess(self, v: Vector) -> np.float32:
        return square(self.voltage(v)) / (self.V * self.V) - ONE

    def gram(self) -> tuple[np.float32, np.float32, np.float32]:
        """M M^T."""
        return (self.dd * self.dd + self.dq * self.dq, self.dd * self.qd + self.dq * self.qq,
                self.qd * self.qd + self.qq * self.qq)


Symmetric = tuple[np.float32, np.float32, np.float32]


def square(x: Vector) -> np.float32:
    return x[0] * x[0] + x[1] * x[1]


def dot(x: Vector, y: Vector) -> np.float32:
    return x[0] * y[0] + x[1] * y[1]


def solve(s: Symmetric, x: Vector) -> Vector:
    inverse = ONE / (s[0] * s[2] - s[1] * s[1])
    return (s[2] * x[0] - s[1] * x[1]) * inverse, (s[0] * x[1] - s[1] * x[0]) * inverse


def times(s: Symmetric, x: Vector) -> Vector:
    return s[0] * x[0] + s[1] * x[1], s[1] * x[0] + s[2] * x[1]


def shrink(K: Symmetric, a: Vector, V: np.float32) -> tuple[Vector, np.float32]:
    w, multiplier = a, ZERO
    for _ in range(ROUNDS):
        power = square(w)
        size = np.sqrt(power)
        if size - V <= ROW_TOLERANCE * V:
            break
        S = (ONE + multiplier * K[0], multiplier * K[1], ONE + multiplier * K[2])
        z = solve(S, times(K, w))
        multiplier = multiplier + ((size - V) / V) * power / dot(w, z)
        w = solve((ONE + multiplier * K[0], multiplier * K[1], ONE + multiplier * K[2]), a)
    return w, multiplier


def project_row(row: Row, r: Vector) -> Vector:
    a = row.voltage(r)
    if square(a) <= row.V * row.V:
        return r
    w, multiplier = shrink(row.gram(), a, row.V)
    step = row.transposed(w)
    return r[0] - multiplier * step[0], r[1] - multiplier * step[1]


def smallest_voltage(goal: Row, limit: Row) -> Vector:
    inverse = ONE / (limit.dd * limit.qq - limit.dq * limit.qd)
    back = Row(limit.qq * inverse, -limit.dq * inverse, -limit.qd * inverse, limit.dd * inverse, (ZERO, ZERO), ONE)
    rest = goal.voltage(back.voltage((-limit.c[0], -limit.c[1])))
    B = Row(goal.dd * back.dd + goal.dq * back.qd, goal.dd * back.dq + goal.dq * back.qq,
            goal.qd * back.dd + goal.qq * back.qd, goal.qd * back.dq + goal.qq * back.qq, (ZERO, ZERO), ONE)
    G = (B.dd * B.dd + B.qd * B.qd, B.dd * B.dq + B.qd * B.qq, B.dq * B.dq + B.qq * B.qq)
    right = B.transposed(rest)
    mu, y = SINGULAR * (G[0] + G[2]), (ZERO, ZERO)
    for _ in range(ROUNDS):
        S = (G[0] + mu, G[1], G[2] + mu)
        y = solve(S, right)
        power = square(y)
        size = np.sqrt(power)
        if size <= limit.V * (ONE + ROW_TOLERANCE):
            break
        mu = mu + ((size - limit.V) / limit.V) * power / dot(y, solve(S, y))
    size = np.sqrt(square(y))
    scale = -limit.V / size if size > limit.V else f(-1)
    return back.voltage((scale * y[0] - limit.c[0], scale * y[1] - limit.c[1]))


@dataclass
class Dual:
    """Concave dual of two rows scaled to V = 1 at one pair of multipliers."""

    v: Vector
    n: list[Vector]
    g: list[np.float32]
    H: Symmetric
    value: np.float32


def scaled(row: Row) -> tuple[Symmetric, Vector, np.float32]:
    s = ONE / row.V
    dd, dq, qd, qq, c = row.dd * s, row.dq * s, row.qd * s, row.qq * s, (row.c[0] * s, row.c[1] * s)
    return ((dd * dd + qd * qd, dd * dq + qd * qq, dq * dq + qq * qq), (dd * c[0] + qd * c[1], dq * c[0] + qq * c[1]),
            c[0] * c[0] + c[1] * c[1] - ONE)


def dual(rows: list, r: Vector, m: list[np.float32]) -> Dual:
    (G0, h0, _), (G1, h1, _) = rows
    H = (ONE + m[0] * G0[0] + m[1] * G1[0], m[0] * G0[1] + m[1] * G1[1], ONE + m[0] * G0[2] + m[1] * G1[2])
    v = solve(H, (r[0] - m[0] * h0[0] - m[1] * h1[0], r[1] - m[0] * h0[1] - m[1] * h1[1]))
    value = HALF * square((v[0] - r[0], v[1] - r[1]))
    n, g = [], []
    for k, (G, h, e) in enumerate(rows):
        Gv = times(G, v)
        n.append((Gv[0] + h[0], Gv[1] + h[1]))
        g.append(HALF * ((dot(v, n[k]) + dot(v, h)) + e))
        value = value + m[k] * g[k]
    return Dual(v, n, g, H, value)


def newton_step(p: Dual, m: list[np.float32]) -> list[np.float32]:
    y = [solve(p.H, p.n[0]), solve(p.H, p.n[1])]
    D, across = [dot(p.n[0], y[0]), dot(p.n[1], y[1])], dot(p.n[0], y[1])
    fixed = [m[k] <= 0 and p.g[k] < 0 for k in range(2)]
    least = SINGULAR * D[0] * D[1]
    det = D[0] * D[1] - across * across
    det = det if det > least else least
    step = [
        ZERO if fixed[k] else p.g[k] / D[k] if fixed[1 - k] else (p.g[k] * D[1 - k] - p.g[1 - k] * across) / det
        for k in range(2)
    ]
    for k in range(2):
        o = 1 - k
        if m[k] + step[k] < 0:
            step[k] = -m[k]
            step[o] = (p.g[o] - across * step[k]) / D[o]
            step[o] = -m[o] if m[o] + step[o] < 0 else step[o]
            break
    return step


def project_pair(first: Row, second: Row, r: Vector) -> Vector | None:
    if second.excess(smallest_voltage(second, first)) > VIOLATION:
        return None
    rows, m = [scaled(first), scaled(second)], []
    for row in (first, second):
        a = row.voltage(r)
        inside = square(a) <= row.V * row.V
        m.append(ZERO if inside else HALF * shrink(row.gram(), a, row.V)[1] * (row.V * row.V))
    point = dual(rows, r, m)
    for _ in range(PAIR_STEPS):
        if all(abs(g) <= PAIR_TOLERANCE or (x <= 0 and g < 0) for g, x in zip(point.g, m, strict=True)):
            break
        step = newton_step(point, m)
        for _ in range(4):
            trial = [m[0] + step[0], m[1] + step[1]]
            following = dual(rows, r, trial)
            if following.value >= point.value - ROUNDING * abs(point.value):
                break
            step = [step[0] * f(0.4), step[1] * f(0.4)]
        m, point = trial, following
    return point.v if point.g[0] <= STALL and point.g[1] <= STALL else None


def project_rows(rows: list[Row], r: Vector) -> tuple[Vector, int] | None:
    """Point and index of the row added last, None when the rows have no common point."""
    x, basis = r, [NONE, NONE]

    def satisfied(point: Vector, skip: int) -> bool:
        return all(k in (NONE, skip) or rows[k].excess(point) <= VIOLATION for k in basis)

    for _ in range(ROUNDS):
        values = [row.excess(x) for row in rows]
        k = int(np.argmax(values))
        if values[k] <= VIOLATION or (k in basis and values[k] <= STALL):
            return x, basis[0]
        if k in basis:
            return None
        alone = project_row(rows[k], r)
        if satisfied(alone, NONE):
            x, basis = alone, [k, NONE]
            continue
        for other in basis:
            both = None if other == NONE else project_pair(rows[k], rows[other], r)
            if both is not None and satisfied(both, other):
                x, basis = both, [k, other]
                break
        else:
            return None
    return None


def row_share(row: Row, p: Vector, way: Vector, slack: np.float32) -> np.float32:
    a = row.voltage(p)
    e = row.dd * way[0] + row.dq * way[1], row.qd * way[0] + row.qq * way[1]
    aa, bb, limit = square(e), a[0] * e[0] + a[1] * e[1], row.V * row.V
    cc = square(a) - limit
    if cc > slack * limit:
        return f(-1)
    cc = min(cc, ZERO)
    root = np.sqrt(bb * bb - aa * cc)
    if bb > 0:
        return -cc / (bb + root)
    return (root - bb) / aa if aa > 0 else ONE


@dataclass
class GovernedTwin(Twin):
    """Current control of one drive with its governor (modes paper, line search and best; circle limit)."""

    held: Vector = (ZERO, ZERO)
    before: Vector = (ZERO, ZERO)
    committed: Vector = (ZERO, ZERO)
    disturbance: Vector = (ZERO, ZERO)
    time_to_go: np.float32 = ZERO
    landing: bool = False
    omega: np.float32 = ZERO
    T_s: np.float32 = ZERO
    V_max: np.float32 = ZERO
    i: Vector = (ZERO, ZERO)
    binding: int = field(default=NONE)

    def model_voltage(self, i: Vector) -> Vector:
        return (self["motor.R_s_ohm"] * i[0] - self.omega * self["motor.L_q_app_h"] * i[1],
                self["motor.R_s_ohm"] * i[1] + self.omega * (self["motor.L_d_app_h"] * i[0] + self["motor.psi_f_wb"]))

    def observe(self, s: np.float32, c: np.float32) -> None:
        sine, cosine = sincos(f(-0.5) * self.T_s * self.omega)
        u = park(self.committed, s * cosine + c * sine, c * cosine - s * sine)
        mean = HALF * (self.i[0] + self.before[0]), HALF * (self.i[1] + self.before[1])
        model, rate, gain = self.model_voltage(mean), ONE / self.T_s, self["governor.observer_gain"]
        z = [u[k] - model[k] - self[f"motor.L_{axis}_h"] * ((self.i[k] - self.before[k]) * rate)
             for k, axis in enumerate("dq")]
        d = self.disturbance
        self.disturbance = d[0] + gain * (z[0] - d[0]), d[1] + gain * (z[1] - d[1])

    def rows(self) -> tuple[list[Row], int]:
        """All rows, and the index of the steady-state one."""
        u0 = self.demand((ZERO - self.i[0], ZERO - self.i[1]), self.i, self.omega)
        K = self["current.K_p_d_v_per_a"], self["current.K_p_q_v_per_a"]
        rows = [Row(K[0], ZERO, ZERO, K[1], u0, self.V_max)]
        offset: Vector = (ZERO, ZERO)
        if int(self.values["governor.mode"]) == PAPER:
            rows += self.prediction(int(self.values["governor.k_max"]))
        elif self.values["governor.observer_gain"] > 0:
            offset = self.disturbance
        else:
            hold, model = rows[0].voltage(self.i), self.model_voltage(self.i)
            offset = hold[0] - model[0], hold[1] - model[1]
        R, w = self["motor.R_s_ohm"], self.omega
        rows.append(Row(R, -w * self["motor.L_q_app_h"], w * self["motor.L_d_app_h"], R,
                        (offset[0], offset[1] + w * self["motor.psi_f_wb"]), (ONE - self["governor.eps"]) * self.V_max))
        steady = len(rows) - 1
        if int(self.values["governor.options"]) & CURRENT_ROW:
            rows.append(Row(ONE, ZERO, ZERO, ONE, (ZERO, ZERO), self["governor.I_transient_apk"]))
        return rows, steady

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
            rows.append(Row(
                K[0] * (ONE - i1[0]) + x1[0], -X[1] * i1[1], X[0] * i1[0], K[1] * (ONE - i1[1]) + x1[1],
                ((x[0] - K[0] * i[0]) - X[1] * i[1], (x[1] - K[1] * i[1]) + X[0] * i[0] + emf), self.V_max,
            ))
        return rows

    def line_search(self, rows: list[Row], steady: int, r: Vector) -> tuple[Vector, int]:
        p = self.held
        way = r[0] - p[0], r[1] - p[1]
        kappa, active = ONE, NONE
        for k, row in enumerate(rows):
            share = row_share(row, p, way, self["governor.slack"])
            if share < kappa:
                kappa, active = share, k
        if kappa >= 0:
            return (p[0] + kappa * way[0], p[1] + kappa * way[1]), active
        return project_row(rows[0], project_row(rows[steady], p)), active

    def solve(self, rows: list[Row], steady: int, r: Vector) -> tuple[Vector, int]:
        if int(self.values["governor.mode"]) == LINE:
            return self.line_search(rows, steady, r)
        found = project_rows(rows, r)
        if found is not None:
            return found
        self.flags |= 64
        found = project_rows(rows[: steady + 1], r) if len(rows) > steady + 1 else None
        return found if found is not None else (smallest_voltage(rows[steady], rows[0]), EMPTY)

    def govern(self, request: Vector) -> Vector:
        options, r = int(self.values["governor.options"]), request
        rows, steady = self.rows()
        if options & PRE_PROJECTION:
            last = rows[steady]
            pre = Row(last.dd, last.dq, last.qd, last.qq, last.c, last.V * f(0.99999))
            both = project_rows([pre, rows[-1]] if len(rows) > steady + 1 else [pre], r)
            r = project_row(pre, r) if both is None else both[0]
        v, active = self.solve(rows, steady, r)
        self.binding = active
        if options & MINIMUM_TIME and int(self.values["governor.mode"]) == BEST:
            v = self.steer(rows[0], r, v, active)
        w = rows[0].voltage(v)
        power = square(w)
        if power > self.V_max * self.V_max:
            share = ONE - self.V_max / np.sqrt(power)
            v = v[0] - share * w[0] / rows[0].dd, v[1] - share * w[1] / rows[0].qq
        if v[0] != request[0] or v[1] != request[1]:
            self.flags |= 32
        return v

    def steer(self, now: Row, r: Vector, v: Vector, active: int) -> Vector:
        if active == NONE:
            landing, self.landing, self.time_to_go = self.landing, False, ZERO
            if not landing:
                return v
            self.binding = STEERED
            out = []
            for k, axis in enumerate("dq"):
                K_p = (now.dd, now.qq)[k]
                gain = (ONE - f(0.26)) * self[f"motor.L_{axis}_h"] / (K_p * self.T_s)
                out.append(self.i[k] + gain * (r[k] - self.i[k]) if gain > 1 else r[k])
            return out[0], out[1]
        steered = self.minimum_time(now, r)
        if steered is None:
            self.time_to_go = ZERO
            return v
        self.landing, self.binding = True, STEERED
        return steered

    def at_time(self, T: np.float32, a: Vector, b: Vector, drops: tuple[Vector, Vector]) -> tuple:
        s, c = sincos(self.omega * T)
        turned = c * b[0] - s * b[1], s * b[0] + c * b[1]
        drop = (drops[0][0] + c * drops[1][0] - s * drops[1][1], drops[0][1] + s * drops[1][0] + c * drops[1][1])
        m = turned[0] - a[0] + drop[0] * T, turned[1] - a[1] + drop[1] * T
        size = np.sqrt(square(m))
        rate = drop[0] - self.omega * turned[1], drop[1] + self.omega * turned[0]
        return m, size, size - self.V_max * T, (m[0] * rate[0] + m[1] * rate[1]) / (size + f(1e-12)) - self.V_max

    def transfer_time(self, way: tuple) -> tuple[np.float32, tuple] | None:
        V, w = self.V_max, abs(self.omega)

        def refine(T: np.float32) -> tuple[np.float32, tuple] | None:
            for _ in range(4):
                point = self.at_time(T, *way)
                if abs(point[2]) <= f(1e-3) * V * T:
                    return (T, point) if point[3] < 0 else None
                if point[3] >= 0:
                    return None
                T = T - point[2] / point[3]
                if T <= 0 or T * w > f(100):
                    return None
            point = self.at_time(T, *way)
            return (T, point) if abs(point[2]) <= f(10) * f(1e-3) * V * T else None

        T = self.time_to_go - self.T_s
        found = refine(T) if T > 0 else None
        if found is not None:
            return found
        _, b, drops = way
        bound = w * np.sqrt(square(b)) + np.sqrt(square(drops[0])) + np.sqrt(square(drops[1])) + V
        low = ZERO
        T = self.at_time(low, *way)[2] / bound
        for _ in range(24):
            if T * w > f(100):
                return None
            point = self.at_time(T, *way)
            if point[2] <= 0:
                high = T
                for _ in range(8):
                    T = HALF * (low + high)
                    low, high = (T, high) if self.at_time(T, *way)[2] > 0 else (low, T)
                return refine(T)
            low = T
            safe = T + point[2] / bound
            T = max(safe, f(1.25) * T)
        return None

    def minimum_time(self, now: Row, target: Vector) -> Vector | None:
        half = HALF * self["motor.R_s_ohm"]
        a, b = ((self["motor.psi_f_wb"] + self["motor.L_d_app_h"] * x[0], self["motor.L_q_app_h"] * x[1])
                for x in (self.i, target))
        drops = (half * self.i[0], half * self.i[1]), (half * target[0], half * target[1])
        found = self.transfer_time((a, b, drops))
        if found is None or found[0] <= f(3) * self.T_s:
            return None
        T, (m, size, *_) = found
        s, c = sincos(HALF * self.T_s * self.omega)
        w = park(m, s, c)
        w = w[0] * (self.V_max / size), w[1] * (self.V_max / size)
        kept = self.keep_current(w)
        if kept is None:
            return None
        self.time_to_go = T
        return (kept[0] - now.c[0]) / now.dd, (kept[1] - now.c[1]) / now.qq

    def keep_current(self, w: Vector) -> Vector | None:
        model, i = self.model_voltage(self.i), self.i
        per = self.T_s / self["motor.L_d_h"], self.T_s / self["motor.L_q_h"]
        free = i[0] - per[0] * model[0], i[1] - per[1] * model[1]
        limit, now = self["governor.I_transient_apk"], square(i)
        bound = now if now > limit * limit else limit * limit
        step = per[0] * w[0], per[1] * w[1]
        if square((free[0] + step[0], free[1] + step[1])) <= bound:
            return w
        if self.flags & 64:
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
        self.observe(s, c)
        v = self.govern(request)
        u = self.demand((v[0] - i[0], v[1] - i[1]), i, omega)
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

