# SPDX-License-Identifier: MIT
"""What the first turn of a shaft says of the wiring: pole pairs, encoder counts and sign, a held shaft, the supply.

The vector's way over the encoder's is the number of pole pairs, and its sign the encoder's, if the counts per turn are
right. A wrong ratio does not say which of the two is wrong; the more usual mistake is named first, and the other with
it: four counts per line, and poles given for pole pairs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pmsmtool.errors import IdentificationError
from pmsmtool.identification.hall import hall_alignment
from pmsmtool.trace import Trace

OK, WRONG, NOT_SEEN, NOT_CHECKED = "ok", "WRONG", "not seen", "NOT CHECKED"
HELD_SHARE = 0.1
"""Way of the encoder, of the vector's over the largest pole pairs that count (64), below which the shaft was held."""
MOST_POLE_PAIRS = 64
LAG_RAD = math.radians(40.0)
"""Electrical angle that friction may leave between rotor and vector at the two ends of a way (a tenth of the rated
current against 3 % of the rated torque: 35 degrees)."""
COUNT_FACTORS = (4.0, 0.25)
"""Counts per turn taken for lines, or lines for counts."""
SUM_LIMIT = 0.1
"""Sum of the phase currents, of the vector: a gain that is 10 % off makes 15 %, one that is 2 % off 3 %."""
SAGS = 0.1
"""Fall of the DC link under the small current, relative, that a supply in current limit makes."""
U_DC_RANGE = (0.7, 1.4)
"""DC link over the stated one beyond which it is not the supply that was stated."""

HALL_WAY_RAD = math.radians(455.0)
"""Electrical way of the first turn from which on Hall wires are judged: friction is taken up, then a whole turn."""

LEAST_CURRENT = 0.3
"""Current that is shown at the end of a push, of the one asked for: less is not given. (A reading as peak of what is
rms makes 0.71, and a slow current loop is not at its end.)"""
BREAKS_IN = 0.7
"""The same at a tenth of the angles over the middle: 0.43 with an open phase, 0.87 and more on healthy drives."""
LEAST_SAMPLES = 8
"""Of a torque pulse whose bend is looked at."""
TOP_SHARE = 0.8
"""Speed, of the fastest of all pulses, from which on the DC link may take the current away: on a motor of the
population a tenth of it was left at 0.94 to 1.0 of the top, all of it at 0.9."""
NOT_LED = "the vector does not lead the rotor"
HALLS_BY = "Hall wires of the connector; two motor leads swapped, if the encoder's sign is wrong, too"
HALLS_SET = "the wires, or hall.axis_1_rad and so on: `pmsmtool identify hall` finds them"
HELD_BY = "brake shut, or the shaft is held; an encoder that does not count; friction above this torque"
SLIPS_BY = "friction, cogging or a load beyond this torque; a brake that is half open"
SIGN_BY = "two motor leads swapped, or the encoder's tracks"
SIGN_FOUND = f"{SIGN_BY}; identify finds the sign by itself and sets it"
POLARITY_BY = f"the polarity of the position (0x607E), or {SIGN_BY}"
FALLS = "the position falls under positive torque"
OPEN_BY = "an open phase, or the supply in current limit; where the shaft turns all the same, what shows the current"
SHOWN_BY = "the object that shows the current has the other sign, or shows magnitudes (0x6078, 0x6077, or the map's)"


@dataclass(frozen=True, slots=True)
class Finding:
    """One row of the check."""

    looked_at: str
    """What was looked at."""
    verdict: str
    """``ok``, ``WRONG``, ``not seen``: nothing is said of it, or ``NOT CHECKED``: this drive cannot show it."""
    shown: str
    """What was seen."""
    likely: str = ""
    """Likely causes of what is wrong, the most likely first."""


def judge_turn(turn: Trace, pole_pairs: int, counts_against: bool) -> list[Finding]:
    """Judge the first turn.

    Parameters
    ----------
    turn : Trace
        ``theta_imposed_rad`` (electrical, unwrapped), ``theta_M_rad`` (mechanical); ``at_rest`` 1 in three rows:
        before, between and after the ways forward and back.
    pole_pairs : int
        As stated.
    counts_against : bool
        Whether the drive is set for an encoder that counts against the phase order.

    Returns
    -------
    list of Finding
        Shaft, pole pairs and counts, sign.
    """
    way_rad = float(np.ptp(turn["theta_imposed_rad"]))
    before, between, after = turn["theta_M_rad"][turn["at_rest"] > 0.5]
    moved = float(np.ptp(turn["theta_M_rad"]))
    unseen = (Finding("pole pairs", NOT_SEEN, NOT_LED), Finding("encoder sign", NOT_SEEN, NOT_LED))
    if moved < HELD_SHARE * way_rad / MOST_POLE_PAIRS:
        due = math.degrees(way_rad / pole_pairs)
        seen = f"the encoder moved by {math.degrees(moved):.2g} deg, {due:.3g} deg are due"
        return [Finding("shaft", WRONG, seen, HELD_BY), *unseen]
    there = between - 0.5 * (before + after)
    ratio = way_rad / there if there else math.inf
    missed = abs(ratio * (after - before))
    if missed > LAG_RAD:
        back = min(math.degrees(missed), 360.0)
        seen = f"after a turn there and back it stands {back:.3g} deg (electrical) or more from where it was"
        return [Finding("shaft", WRONG, seen, SLIPS_BY), *unseen]
    against = ratio < 0.0
    shown, set_for = ("against" if each else "with" for each in (against, counts_against))
    seen = f"counts {shown} the phase order; the drive is set for counting {set_for} it"
    return [
        Finding("shaft", OK, f"follows the vector there and back within {math.degrees(missed):.2g} deg (electrical)"),
        _pole_pairs(abs(ratio), pole_pairs, LAG_RAD / way_rad),
        Finding("encoder sign", OK, seen)
        if against == counts_against
        else Finding("encoder sign", WRONG, seen, SIGN_FOUND),
    ]


def _pole_pairs(ratio: float, stated: int, same: float) -> Finding:
    """Return the row of a ratio of electrical to encoder angle, which is known to a share ``same``."""
    if abs(ratio / stated - 1.0) <= same or round(ratio) == stated:
        return Finding("pole pairs", OK, f"{ratio:.3g} measured, {stated} stated; the counts per turn fit, too")
    factor, other = stated / ratio, round(ratio)
    seen = f"{ratio:.3g} electrical turns per turn of the encoder, {stated} pole pairs are stated"
    counts = f"counts per turn: the encoder shows {factor:.3g} times the angle"
    pairs = f"{other} pole pairs"
    if other < 1 or abs(ratio / other - 1.0) > same:
        return Finding("encoder counts", WRONG, seen, counts)
    if any(abs(factor / usual - 1.0) <= same for usual in COUNT_FACTORS):
        return Finding("encoder counts", WRONG, seen, f"{counts}; or {pairs}")
    return Finding("pole pairs", WRONG, seen, f"{pairs}; or {counts}")


def judge_halls(turn: Trace, axes_rad: Sequence[float] = ()) -> Finding:
    """Judge the Hall wires by the sectors that a led rotor passes.

    Parameters
    ----------
    turn : Trace
        As of :func:`judge_turn`, with ``hall_pattern``: bit k is wire k + 1.
    axes_rad : sequence of float, optional
        What a drive that commutates by them holds, ``hall.axis_1_rad`` and so on; default: the wires are to have the
        order of the phases.
    """
    name, pattern, led = "Hall wires", turn["hall_pattern"], turn["at_rest"] < 0.5
    if np.ptp(pattern) == 0.0:
        return Finding(name, NOT_SEEN, "no wire changes: none is connected, or none is supplied")
    imposed = turn["theta_imposed_rad"][led]
    if np.ptp(imposed) < HALL_WAY_RAD:
        way = math.degrees(float(np.ptp(imposed)))
        return Finding(name, NOT_SEEN, f"the turn of {way:.3g} deg (electrical) is too short; see identify hall")
    signals = {"commanded_rad": imposed, "angle_rad": imposed, "hall_pattern": pattern[led]}
    try:
        found = hall_alignment(Trace(turn.t_s[led], signals, dict.fromkeys(signals, "1"), {}))
    except IdentificationError as error:
        return Finding(name, WRONG, error.what, "a wire that is open, or sensors 60 deg apart; " + HALLS_BY)
    if axes_rad:
        pairs = zip(found.axes_rad, axes_rad, strict=True)
        off = max(abs(math.remainder(there - held, 2.0 * math.pi)) for there, held in pairs)
        seen = f"up to {math.degrees(off):.2g} deg (electrical) from hall.axis_1_rad and so on"
        return Finding(name, WRONG, seen, HALLS_SET) if off > LAG_RAD else Finding(name, OK, seen)
    if found.wiring:
        return Finding(name, WRONG, found.wiring, HALLS_BY)
    return Finding(name, OK, f"in the order of the phases, {math.degrees(found.offset_rad):+.2g} deg off (electrical)")


def judge_current(turn: Trace, i_a: float) -> list[Finding]:
    """Judge the torque current that is shown while a vector turns: with an open phase it breaks in at some angles.

    Parameters
    ----------
    turn : Trace
        ``i_q_a``, ``at_rest``.
    i_a : float
        Length of the vector (A peak).
    """
    led = turn["at_rest"] < 0.5
    share = float(np.percentile(np.abs(turn["i_q_a"][led]) / i_a, 10.0))
    if share >= LEAST_CURRENT:
        return []
    seen = f"at a tenth of the angles {100.0 * share:.2g} % of the current asked for is shown, or less"
    return [Finding("phases", WRONG, seen, OPEN_BY)]


NOT_BACK_BY = "a motor lead that is not connected; a load that turns the shaft; the encoder's sign or offset"
"""An open phase turns the rotor towards one angle, whatever the sign of the torque that is asked for."""


def judge_push(pushes: Trace) -> list[Finding]:
    """Judge two torque pushes, forth and back, of a drive that commutates by itself.

    Parameters
    ----------
    pushes : Trace
        ``i_command_a``, ``i_q_a``, ``way_rad``, one row per push.

    Returns
    -------
    list of Finding
        Shaft, sign, and the phases where no current flows.
    """
    command, way = pushes["i_command_a"], pushes["way_rad"]
    turned = _sign_shown(pushes["i_q_a"] / command, command)
    share = float(np.mean(pushes["i_q_a"] / command))
    ways = " and ".join(f"{math.degrees(each):+.2g} deg" for each in way)
    found = turned
    if share < LEAST_CURRENT and not turned:
        seen = f"the drive shows {100.0 * share:.2g} % of the current asked for"
        found.append(Finding("phases", WRONG, seen, OPEN_BY))
    if not np.any(way):
        return [*found, Finding("shaft", NOT_SEEN, "mend what is wrong first")]
    if way[0] * way[1] >= 0.0:
        how = "both the same way" if np.all(way) else "one way alone"
        return [*found, Finding("shaft", WRONG, f"torque forth and back moves the shaft by {ways}, {how}", NOT_BACK_BY)]
    found.append(Finding("shaft", OK, f"torque forth and back moves it by {ways}"))
    if way[0] * command[0] < 0.0:
        return [*found, Finding("encoder sign", WRONG, FALLS, POLARITY_BY)]
    return [*found, Finding("encoder sign", OK, "the position grows under positive torque")]


def judge_pulses(pulses: Sequence[Trace]) -> list[Finding]:
    """Return what longer torque pulses show to be wrong: no current that was asked for, a position that falls.

    ``pulses``: ``theta_M_rad``, ``i_q_a``, and in the conditions the ``i_command_a`` of each.
    """
    known = _looked_at(pulses)
    if not known:
        return []
    commands = [float(pulse.meta["i_command_a"]) for pulse in known]
    shown = _given(known, commands)
    if not len(shown):
        return []
    each = [_given([pulse], [i]) for pulse, i in zip(known, commands, strict=True)]
    told = [(float(np.median(given)), i) for given, i in zip(each, commands, strict=True) if len(given)]
    turned = _sign_shown(*np.array(told).reshape(-1, 2).T)
    if turned:
        return turned
    low, share = (float(np.percentile(shown, percent)) for percent in (10.0, 50.0))
    if share < LEAST_CURRENT:
        return [Finding("phases", WRONG, f"the drive shows {100.0 * share:.2g} % of the current asked for", OPEN_BY)]
    if low < LEAST_CURRENT * share:  # 0.87 to 0.98 of it on healthy drives, 0.02 to 0.1 with an open phase that turns
        seen = f"at a tenth of the angles {100.0 * max(0.0, low):.2g} % of the current asked for is shown, or less"
        return [Finding("phases", WRONG, seen, OPEN_BY)]
    bends = [float(np.polyfit(pulse.t_s - pulse.t_s[0], pulse["theta_M_rad"], 2)[0]) for pulse in known]
    if sum(math.copysign(1.0, bend * i) for bend, i in zip(bends, commands, strict=True)) < 0.0:
        return [Finding("encoder sign", WRONG, FALLS, POLARITY_BY)]
    return []


def _looked_at(pulses: Sequence[Trace]) -> list[Trace]:
    return [pulse for pulse in pulses if len(pulse) > LEAST_SAMPLES and pulse.meta.get("i_command_a")]


def breaks_in(pulses: Sequence[Trace]) -> str:
    """Return the open phase that is likely where the current of torque pulses breaks in at angles; empty: it does not.

    No verdict: pulses that turn by half a turn (electrical) or less may pass by the angles where nothing flows.
    """
    known = _looked_at(pulses)
    shown = _given(known, [float(pulse.meta["i_command_a"]) for pulse in known]) if known else ()
    low, middle = np.percentile(shown, (10.0, 50.0)) if len(shown) else (1.0, 1.0)
    seen = f"of the current asked for {100.0 * low:.2g} % is shown at a tenth of the angles, and {100.0 * middle:.2g} %"
    return f"an open phase: {seen} at most of them" if low < BREAKS_IN * middle else ""


def _sign_shown(shares: NDArray[np.float64], commands: NDArray[np.float64]) -> list[Finding]:
    """Judge whether currents of both signs flow and one of them is shown with the other sign."""
    if not (np.any(commands > 0.0) and np.any(commands < 0.0)):
        return []
    forth, back = (float(np.median(shares[commands * sign > 0.0])) for sign in (1.0, -1.0))
    if min(abs(forth), abs(back)) < LEAST_CURRENT or min(forth, back) > 0.0:
        return []
    seen = f"of a positive current {100.0 * forth:.2g} % is shown, of a negative one {100.0 * back:.2g} %"
    return [Finding("current sensors", WRONG, seen, SHOWN_BY)]


def _given(pulses: Sequence[Trace], commands: Sequence[float]) -> NDArray[np.float64]:
    """Return the current shown over the one asked for, where nothing but an open phase keeps it away.

    A slow current loop behind a large dead time gives it late (40 to 65 ms on one), so that what comes before the
    latest of the first arrivals says nothing; nor does what comes near the largest speed, where the voltage ends.
    """
    late_s, speeds = 0.0, []
    for pulse, i in zip(pulses, commands, strict=True):
        t, angle, k = pulse.t_s, pulse["theta_M_rad"], max(1, len(pulse) // 16)
        low, high = np.clip(np.arange(len(t)) - k, 0, None), np.clip(np.arange(len(t)) + k, None, len(t) - 1)
        speeds.append(np.abs(angle[high] - angle[low]) / (t[high] - t[low]))
        there = pulse["i_q_a"] / i >= LEAST_CURRENT
        if np.any(there):
            late_s = max(late_s, float(t[np.argmax(there)] - t[0]))
    limit = TOP_SHARE * max(float(np.max(speed)) for speed in speeds)
    shares = []
    for pulse, i, speed in zip(pulses, commands, speeds, strict=True):
        since = pulse.t_s - pulse.t_s[0]
        taken = (since >= max(late_s, 0.25 * since[-1])) & (speed <= limit)
        shares.append(pulse["i_q_a"][taken] / i)
    return np.concatenate(shares)


def judge_sensors(vectors: Trace) -> Finding:
    """Judge whether the three phase currents of three vectors add up to the same, whatever the offsets are.

    ``vectors``: as of ``phase_check.check_phases``.
    """
    total = vectors["i_a_a"] + vectors["i_b_a"] + vectors["i_c_a"]
    share = float(np.ptp(total) / np.abs(np.mean(vectors["i_d_a"])))
    seen = f"the phase currents add up to {100.0 * share:.2g} % of the current"
    if share > SUM_LIMIT:
        return Finding("current sensors", WRONG, seen, "the gain of one sensor, or two sensors exchanged")
    return Finding("current sensors", OK, seen)


def judge_supply(U_rest_v: float, turn: Trace | None, U_stated_v: float | None) -> Finding:
    """Judge the DC link (V) at rest against the stated one, and under the current of the first turn against rest."""
    low, high = U_DC_RANGE
    stated = "" if U_stated_v is None else f", {U_stated_v:.4g} V are stated"
    if U_stated_v is not None and not low * U_stated_v <= U_rest_v <= high * U_stated_v:
        return Finding(
            "supply", WRONG, f"DC link {U_rest_v:.4g} V{stated}",
            "supply off, or set to another voltage" if U_rest_v < U_stated_v
            else "another supply, or the file of another motor",
        )  # fmt: skip
    if turn is not None:
        least = float(np.min(turn["U_dc_v"]))
        if least < (1.0 - SAGS) * U_rest_v:
            return Finding(
                "supply", WRONG, f"DC link falls from {U_rest_v:.4g} V to {least:.4g} V under the current of the test",
                "the supply is in current limit, or its fuse or pre-charge resistor is still in the way",
            )  # fmt: skip
    return Finding("supply", OK, f"DC link {U_rest_v:.4g} V{stated}")


def link_at_rest(at_rest: Trace) -> float:
    """Return the mean of the DC link ``U_dc_v`` without a current (V); NaN where it was not recorded."""
    return float(np.mean(at_rest["U_dc_v"])) if "U_dc_v" in at_rest.signals else math.nan


def supply_under_load(at_rest: Trace, loaded: Trace) -> Finding | None:
    """Judge the DC link under a current against that without one; None where either was not recorded (``U_dc_v``)."""
    if "U_dc_v" not in at_rest.signals or "U_dc_v" not in loaded.signals:
        return None
    return judge_supply(link_at_rest(at_rest), loaded, None)


SUPPLY, LINK_AT_REST = "supply_w", "U_dc_rest_v"
"""Conditions of a machine file: the power from which on its DC link gives way, and the link before anything moved."""


def supply_power(at_rest: Trace, loaded: Trace) -> tuple[float, float]:
    """Return the power from which on the DC link falls by :data:`SAGS`, and that of the largest current held (W).

    The supply is taken for a voltage behind a resistance: the link falls with the current drawn from it. Infinite where
    it falls by less than :data:`SAGS` of :data:`SAGS`, which a meter's scatter may be, or was not recorded.

    ``at_rest``, ``loaded``: ``U_dc_v`` without a current, and under direct currents ``i_d_a`` (A peak) of the voltages
    ``u_d_v``.
    """
    if "U_dc_v" not in at_rest.signals or "U_dc_v" not in loaded.signals:
        return math.inf, 0.0
    largest = int(np.argmax(np.abs(loaded["i_d_a"])))
    U_rest_v, U_v = link_at_rest(at_rest), float(loaded["U_dc_v"][largest])
    held_w = 1.5 * float(loaded["u_d_v"][largest] * loaded["i_d_a"][largest])
    fall = 1.0 - U_v / U_rest_v
    if fall < SAGS * SAGS or not held_w > 0.0:
        return math.inf, held_w
    return held_w * (SAGS / fall) * (1.0 - SAGS) / (1.0 - fall), held_w
