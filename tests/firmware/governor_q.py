# SPDX-License-Identifier: MIT
"""The fixed-point governor behind floating-point signals, for closed loops. Test code only."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pmsmtool.commissioning.export import LARGEST, ONE, fixed_point_files, q_files, q_format
from pmsmtool.firmware.export_c import FLAGS
from pmsmtool.native import parse_structs


def governor_types(text: str) -> Mapping[str, Any]:
    """ctypes structures of the header, its Q27 numbers being plain words."""
    return parse_structs(text.replace("pmsm_q27 ", "int32_t ").replace("typedef int32_t int32_t", "typedef int x"))


def quantised(value: float, base: float) -> int:
    """A signal as Q4.27 of its base, saturated as the C code saturates."""
    return max(-LARGEST, min(LARGEST, round(value / base * ONE)))


class FixedPointSignals:
    """State and input structures of one motor; currents in A, voltages in V, speed in rad/s."""

    def __init__(self, values: Mapping[str, float]) -> None:
        self.format = q_format(values)
        self.types = governor_types(dict(fixed_point_files())["pmsm_governor_q.h"])
        self.state = self.types["pmsm_governor_q_state"]()
        self.input = self.types["pmsm_governor_q_input"]()

    def hold(self, v: tuple[float, float]) -> None:
        """Set the last governed reference (A)."""
        self.state.held.d, self.state.held.q = (quantised(x, self.format.I_base) for x in v)

    def give(
        self,
        request: tuple[float, float],
        i: tuple[float, float],
        integrator: tuple[float, float],
        omega_e: float,
        V_max: float,
    ) -> None:
        """Set the input of a period."""
        q, given = self.format, self.input
        for part, pair, base in (
            ("request", request, q.I_base),
            ("i", i, q.I_base),
            ("integrator", integrator, q.U_base),
        ):
            member = getattr(given, part)
            member.d, member.q = (quantised(x, base) for x in pair)
        given.omega_e, given.V_max = quantised(omega_e, q.omega_base), quantised(V_max, q.U_base)


class FixedPointGovernor(FixedPointSignals):
    """The same with the compiled governor."""

    def __init__(self, values: Mapping[str, float], folder: Path, compiler: str) -> None:
        super().__init__(values)
        files = q_files(values, prefix="motor")
        for name, text in files.items():
            (folder / name).write_text(text)
        subprocess.run(
            [
                compiler,
                *FLAGS.split(),
                "-O2",
                "-fPIC",
                "-shared",
                "-o",
                "governor_q.so",
                *(name for name in files if name.endswith(".c")),
            ],
            cwd=folder,
            check=True,
        )
        library = ctypes.CDLL(str(folder / "governor_q.so"))
        self.constants = self.types["pmsm_governor_q_constants"].in_dll(library, "motor_cfg_q")
        self.function = library.pmsm_governor_q
        self.function.restype = self.types["pmsm_q27_dq"]

    def govern(
        self,
        request: tuple[float, float],
        i: tuple[float, float],
        integrator: tuple[float, float],
        omega_e: float,
        V_max: float,
    ) -> tuple[float, float]:
        """Return the governed reference (A)."""
        self.give(request, i, integrator, omega_e, V_max)
        v = self.function(ctypes.byref(self.constants), ctypes.byref(self.state), ctypes.byref(self.input))
        return v.d / ONE * self.format.I_base, v.q / ONE * self.format.I_base
