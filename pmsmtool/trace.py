# SPDX-License-Identifier: MIT
"""Trace: named signals over one time base, with units and the facts needed to read them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.plain_text import Summarised, Summary


@dataclass(frozen=True, slots=True, repr=False)
class Trace(Summarised):
    """Samples of several signals at common instants.

    Row k of a drive trace holds the currents and the angle *sampled* at ``t_s[k]`` and the voltage
    command *computed* there, which acts in the stator frame one period later (identification
    reference, "trace row k").

    Parameters
    ----------
    t_s : ndarray, shape (n,)
        Sampling instants (s), increasing.
    signals : mapping of str to ndarray, shape (n,)
        One array per signal; the unit is the name's suffix (``i_d_a``, ``u_q_v``, ``theta_e_rad``).
    units : mapping of str to str
        Unit of each signal, as in ``units.UNITS``.
    meta : mapping
        JSON-serialisable facts: period, excitation, temperatures, flags' meaning.
    """

    t_s: NDArray[np.float64]
    signals: Mapping[str, NDArray[np.float64]]
    units: Mapping[str, str]
    meta: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, values in self.signals.items():
            if values.shape != self.t_s.shape:
                raise ValueError(f"signal {name} has {values.shape}, the time base {self.t_s.shape}")
            if name not in self.units:
                raise ValueError(f"signal {name} has no unit")

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return one signal; raises ``KeyError`` with the nearest name where there is none."""
        try:
            return self.signals[name]
        except KeyError:
            near = get_close_matches(name, self.signals, n=1, cutoff=0.5)
            raise KeyError(f"no signal {name!r}" + (f"; did you mean {near[0]}?" if near else "")) from None

    def summary(self) -> Summary:
        """Return the range of each signal."""
        span = f" from {self.t_s[0]:.6g} to {self.t_s[-1]:.6g} s" if len(self) else ""
        units = {name: "-" if unit == "1" else unit for name, unit in self.units.items()}  # "1" looks like a value
        rows = [
            (name, units[name], *((f"{values.min():.5g}", f"{values.max():.5g}") if len(self) else ("", "")))
            for name, values in self.signals.items()
        ]
        notes = [self.trip] if self.trip else []
        return Summary(f"trace: {len(self)} rows{span}", ("signal", "unit", "least", "largest"), rows, notes)

    @property
    def trip(self) -> str:
        """Whether and when a simulated drive switched off by itself, as a sentence; else an empty text."""
        codes = self.signals.get("trip")
        if codes is None or not codes.any():
            return ""
        first = int((codes != 0).argmax())
        return f"the drive tripped (error code {int(codes[first]):#06x}) at {self.t_s[first]:.6g} s"

    @staticmethod
    def load(path: str | Path) -> Trace:
        """Read a trace that a command wrote (.npz or .csv), as :func:`~pmsmtool.trace_file.read_trace` does."""
        from pmsmtool.trace_file import read_trace

        return read_trace(Path(path))

    def __len__(self) -> int:
        return len(self.t_s)

    @property
    def period_s(self) -> float:
        """Sampling period (s)."""
        return float(self.t_s[-1] - self.t_s[0]) / (len(self.t_s) - 1)
