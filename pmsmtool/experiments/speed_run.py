"""Steady speeds in both directions at i_d = 0: means for the flux linkage and the fine encoder offset."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pmsmtool.drive.port import Drive, Excitation, Injection, Shape
from pmsmtool.experiments.signals import readable, table
from pmsmtool.trace import Trace

SHARES = (0.25, 0.45, 0.65, 0.85)
"""Of the largest speed of the run, both directions (identification reference, 3.4)."""
MEANS = ("u_d_v", "u_q_v", "i_d_a", "i_q_a", "omega_e_rad_s", "T_magnet_c", "T_winding_c", "flags")
WAVES = ("i_d_a", "i_q_a", "theta_e_rad")

LOOK_S = 0.05
NEAR = 0.005
"""Relative distance from the set speed that counts as reached."""
REACH_LIMIT_S = 8.0
"""A speed that is not reached by then is measured as it is; the estimator sees it in the halves of the window."""


@dataclass(frozen=True, slots=True)
class SpeedPlan:
    """Speeds to hold.

    Attributes
    ----------
    speeds_rad_s : sequence of float
        Mechanical speeds in the order they are held (rad/s).
    pole_pairs : int
        Pole pairs, to average over whole mechanical turns.
    settle_s : float
        Time between reaching the speed and the window (s).
    window_s : float
        Shortest window (s); it is rounded up to whole mechanical turns.
    wave_samples : int
        Samples of the current waveform recorded at each speed, 0 for none.
    """

    speeds_rad_s: Sequence[float]
    pole_pairs: int
    settle_s: float = 0.25
    window_s: float = 0.15
    wave_samples: int = 2048

    def duration_s(self) -> float:
        """Return about how long the run takes (s)."""
        return sum(self.settle_s + 2.0 * (self.window_s + 2.0 * math.pi / abs(w)) for w in self.speeds_rad_s)


def speeds_of(omega_max_rad_s: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the speeds in two groups, one for each sign of i_d; each has every second share in each direction."""
    odd, even = SHARES[::2], SHARES[1::2]
    groups = ((odd, even), (even, odd))
    return tuple(  # type: ignore[return-value]
        tuple(
            sign * share * omega_max_rad_s for sign, shares in zip((1.0, -1.0), group, strict=True) for share in shares
        )
        for group in groups
    )


Rows = list[dict[str, float]]


def hold_speeds(drive: Drive, plan: SpeedPlan) -> tuple[Rows, list[Trace]]:
    """Hold the speeds and return one row of means for each, and the current waveforms.

    The drive is enabled on entry with a speed controller that holds the machine; it is asked for standstill on return.
    """
    rows: Rows = []
    waves = []
    for speed in plan.speeds_rad_s:
        drive.command_speed(speed)
        reach(drive, speed * plan.pole_pairs)
        drive.wait(plan.settle_s)
        half = _half_window(drive, plan, speed)
        first, second = (drive.average(MEANS, half) for _ in range(2))
        row = {name: 0.5 * (first[name] + second[name]) for name in MEANS if name != "flags"}
        for name in ("i_d", "i_q"):
            row[f"{name}_first_a"], row[f"{name}_second_a"] = first[f"{name}_a"], second[f"{name}_a"]
        row["omega_first_rad_s"] = first["omega_e_rad_s"]
        row["omega_second_rad_s"] = second["omega_e_rad_s"]
        row["flagged"] = float(first["flags"] + second["flags"] > 0.0)  # a mean of flag words: any bit counts
        rows.append(row)
        if plan.wave_samples:
            waves.append(readable(drive.record(WAVES, plan.wave_samples)))
    drive.command_speed(0.0)
    return rows, waves


def speeds_trace(rows: Rows, pole_pairs: int) -> Trace:
    """Return the rows of all groups as one trace; its time base counts them."""
    return table(rows, [float(k) for k in range(len(rows))], pole_pairs=pole_pairs)


def reach(drive: Drive, omega_e_rad_s: float, *, limit_s: float = REACH_LIMIT_S, band_rad_s: float = 0.0) -> float:
    """Wait until the speed has arrived within a band, seen twice, or the limit is over; return the time (s)."""
    periods = max(1, round(0.5 * LOOK_S / drive.period_s))
    waited = 0.0
    seen = 0
    while waited < limit_s and seen < 2:
        drive.wait(0.5 * LOOK_S)
        omega = drive.average(("omega_e_rad_s",), periods)["omega_e_rad_s"]
        waited += LOOK_S
        seen = seen + 1 if abs(omega - omega_e_rad_s) <= max(band_rad_s, NEAR * abs(omega_e_rad_s)) else 0
    return waited


def _half_window(drive: Drive, plan: SpeedPlan, speed: float) -> int:
    """Periods of half a window: whole mechanical turns, so that what repeats per turn averages out."""
    turn_s = 2.0 * math.pi / abs(speed)
    turns = max(1, math.ceil(0.5 * plan.window_s / turn_s))
    return max(64, round(turns * turn_s / drive.period_s))


def push_and_record(drive: Drive, i_q_a: float, samples: int, decimation: int, abort_speed_rad_s: float) -> Trace:
    """Apply a q current for the length of a record; returns speed, currents and voltages of the acceleration.

    The drive ends the push by itself at the abort speed (electrical rad/s).
    """
    excitation = Excitation(
        shape=Shape.STEP,
        point=Injection.I_Q,
        amplitude=i_q_a,
        duration_s=samples * decimation * drive.period_s,
        abort_speed_rad_s=abort_speed_rad_s,
    )
    drive.command_current(0.0, 0.0)  # the frame follows the rotor again, whatever was held before
    names = ("i_d_a", "i_q_a", "u_d_v", "u_q_v", "omega_e_rad_s", "theta_m_rad", "flags")
    return readable(drive.record(names, samples, decimation=decimation, excitation=excitation), i_command_a=i_q_a)
