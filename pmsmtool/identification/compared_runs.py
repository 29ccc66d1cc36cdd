# SPDX-License-Identifier: MIT
"""Two runs side by side, and many: what differs beyond the intervals, what the values of a series look like."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pmsmtool.estimators.estimate import (
    COVERAGE_FACTOR,
    MEDIAN_TO_STD,
    SensorTolerance,
    statistical_half_width,
    total_half_width,
)
from pmsmtool.machine.parameters import Estimate, MachineParameters
from pmsmtool.machine.temperature import UNKNOWN_T_RANGE_C, WINDING_TOLERANCE, magnet_tolerance_per_k
from pmsmtool.params.parameter_set import Difference as ParameterDifference
from pmsmtool.params.parameter_set import compare, read_parameter_set
from pmsmtool.units import format_quantity

LEAST_SERIES = 5
"""Runs of a quantity from which a median and a spread say something, and an odd one can be named."""
ODD = 3.5
"""Distance from the median, in robust standard deviations, that makes a value odd (Iglewicz and Hoaglin 1993)."""

MEASURED = ("pmsmtool", "vendor")
"""Sources of values that a run measured."""
TREND = 2.576
"""Standard deviations of the test for a trend: 99 %."""


@dataclass(frozen=True, slots=True)
class Difference:
    """One quantity in two runs."""

    name: str
    unit: str
    """As in the machine file."""
    first: float | None
    second: float | None
    """Values; None where the run did not accept one."""
    difference: float
    interval: float
    """Second minus first, and its 95 % half width; NaN where one is missing."""

    @property
    def verdict(self) -> str:
        """``agrees``, ``differs``, or which run lacks it."""
        if self.first is None or self.second is None:
            return f"only in the {'second' if self.first is None else 'first'}"
        return "agrees" if abs(self.difference) <= self.interval else "differs"


def differences(
    first: Mapping[str, Estimate],
    second: Mapping[str, Estimate],
    *,
    same_sensors: bool,
    machine: MachineParameters | None = None,
    together: bool = False,
) -> list[Difference]:
    """Return every quantity of either run, in the order of the names; angles the short way round.

    Parameters
    ----------
    same_sensors : bool
        Whether both were measured by one drive: what its sensors are off by is then in both alike and does not count.
    machine : MachineParameters, optional
        What is known of winding and magnets. With it the way to the reference temperature counts on one drive, too
        (:func:`thermal_half_width`); without it only where ``same_sensors`` does not hold.
    together : bool
        Whether the 95 % are those of all quantities together (Bonferroni's inequality) instead of each one's.
    """
    half = statistical_half_width if same_sensors else total_half_width
    rows = []
    for name in sorted({*first, *second}):
        a, b = first.get(name), second.get(name)
        known = a or b
        assert known is not None
        if a is None or b is None:
            values = None if a is None else a.value, None if b is None else b.value
            rows.append(Difference(name, known.unit, *values, math.nan, math.nan))
        else:
            change = b.value - a.value
            change = math.remainder(change, 2.0 * math.pi) if a.unit == "rad" else change
            thermal = thermal_half_width(name, a, b, machine) if same_sensors and machine is not None else 0.0
            rows.append(Difference(name, a.unit, a.value, b.value, change, math.hypot(half(a), half(b), thermal)))
    if not together:
        return rows
    count = max(1, sum(row.interval > 0.0 for row in rows))
    wider = statistics.NormalDist().inv_cdf(1.0 - 0.025 / count) / COVERAGE_FACTOR
    return [replace(row, interval=wider * row.interval) for row in rows]


def within(rows: Iterable[Difference], share: float) -> list[Difference]:
    """Return the rows with a share of the first value as limit, in place of the interval."""
    return [row if row.first is None else replace(row, interval=share * abs(row.first)) for row in rows]


def other_parameters(first: Path, second: Path, share: float) -> list[ParameterDifference] | None:
    """Return the parameters of two runs' sets that differ by more than a share; None where a run has no set."""
    files = [path / "params.toml" for path in (first, second)]
    if not all(file.is_file() for file in files):
        return None
    return [row for row in compare(*map(read_parameter_set, files)) if not abs(row.relative) <= share]


def thermal_half_width(name: str, first: Estimate, second: Estimate, machine: MachineParameters) -> float:
    """Return what R or psi of one machine may differ by at T_ref because they were measured at two temperatures (95 %).

    The temperature sensor is where the winding is not, the copper share of the loop and the magnets' coefficient are
    known no better than the machine file says. Two runs of one simulated drive 35 K apart differed by up to 2.0 % of R
    where the statistical parts allow 0.6 %. Unit of the values; 0 for other quantities.
    """
    sensors = SensorTolerance()
    if name == "R_s_ohm":
        alpha = machine.alpha_R_per_k
        winding = machine.R_winding_ohm
        unknown = sensors.device_share_max if winding is None else WINDING_TOLERANCE * winding / abs(first.value)
        per_k = alpha * unknown
    elif name == "psi_f_wb":
        alpha, per_k = machine.alpha_psi_per_k, magnet_tolerance_per_k(machine)
    else:
        return 0.0
    apart = abs(first.T_c - second.T_c)
    low, high = UNKNOWN_T_RANGE_C
    share = math.hypot(alpha * sensors.temperature_k, per_k * apart) if apart < math.inf else abs(alpha) * (high - low)
    return share * abs(first.value)


DRIVE = ("vendor", "product", "serial")
"""What names a drive (0x1018): node id and firmware may change, and a commissioning records its level, too."""


def same_drive(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Return whether two records name one drive; never where it tells no serial number."""
    return bool(first.get("serial")) and all(first.get(key) == second.get(key) for key in DRIVE)


def told(row: Difference) -> tuple[str, ...]:
    """Return a row as text: name, both values, difference, interval; "-" where there is none."""

    def text(value: float | None, digits: int) -> str:
        return "-" if value is None or math.isnan(value) else format_quantity(value, row.unit, digits)

    interval = "-" if math.isnan(row.interval) else f"+-{text(row.interval, 2)}"
    return row.name, *(text(value, 4) for value in (row.first, row.second, row.difference)), interval


@dataclass(frozen=True, slots=True)
class Series:
    """One quantity over many runs."""

    name: str
    unit: str
    """As in the machine file."""
    runs: int
    """In how many it was accepted."""
    median: float
    spread: float
    """Median, and robust standard deviation (NaN below ``LEAST_SERIES`` runs)."""
    interval: float
    """Median total 95 % half width of one run."""
    odd: tuple[str, ...] = ()
    """Runs whose value stands out of the others by more than the series' spread and its own interval."""
    drift: float = math.nan
    """Change from the first run to the last by the median slope, where Mann and Kendall's test sees one at 99 %; NaN
    where it sees none, which it cannot below 7 runs."""


def measured(estimates: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Return the estimates that were measured: what a data sheet says of one type is the same in all runs."""
    return {name: estimate for name, estimate in estimates.items() if estimate.source in MEASURED}


def drift(values: Sequence[float]) -> float:
    """Return the change over a series in order of time, NaN where no trend is seen at 99 %.

    The test of H. B. Mann (Econometrica 13 (1945) 245, doi:10.2307/1907187) and the median slope of P. K. Sen (J. Am.
    Stat. Assoc. 63 (1968) 1379, doi:10.1080/01621459.1968.10480934).
    """
    n = len(values)
    pairs = [(i, j) for j in range(n) for i in range(j)]
    rising = sum((values[j] > values[i]) - (values[j] < values[i]) for i, j in pairs)
    deviation = math.sqrt(n * (n - 1.0) * (2.0 * n + 5.0) / 18.0)
    if not pairs or abs(rising) - 1.0 <= TREND * deviation:
        return math.nan
    return (n - 1.0) * statistics.median((values[j] - values[i]) / (j - i) for i, j in pairs)


def series(runs: Iterable[tuple[str, Mapping[str, Estimate]]]) -> list[Series]:
    """Return the statistics of every quantity over runs, each with its name."""
    found: dict[str, list[tuple[str, Estimate]]] = {}
    for run, estimates in runs:
        for name, estimate in estimates.items():
            found.setdefault(name, []).append((run, estimate))
    return [_series(name, found[name]) for name in sorted(found)]


def _series(name: str, found: Sequence[tuple[str, Estimate]]) -> Series:
    values = [estimate.value for _, estimate in found]
    interval = statistics.median(total_half_width(estimate) for _, estimate in found)
    median = statistics.median(values)
    spread, odd = math.nan, list[str]()
    if len(values) >= LEAST_SERIES:
        spread = MEDIAN_TO_STD * statistics.median(abs(value - median) for value in values)
        for run, estimate in found:
            allowed = max(ODD * spread, math.hypot(total_half_width(estimate), interval))
            if abs(estimate.value - median) > allowed:
                odd.append(run)
    return Series(name, found[0][1].unit, len(values), median, spread, interval, tuple(odd), drift(values))
