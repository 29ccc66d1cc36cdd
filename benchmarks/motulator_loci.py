# SPDX-License-Identifier: MIT
"""Table of motulator's reference generator, for ``lookup_table.py``: run by a Python that has motulator >= 0.18.

``python motulator_loci.py IN.npz OUT.npz``. IN holds the flux map (i_d_a, i_q_a, psi_d_wb, psi_q_wb), the axes and the
limits; OUT the currents of every cell and the processor time (s) the loci and all cells took, imports not counted. The
loci are motulator's (16 points); the tracking law is stepped to its fixed point, alpha T_s = 1, as for a table.
"""

import math
import sys
import time
from typing import Any

import numpy as np
from motulator.drive.control._sm_reference_gen import ReferenceGenerator
from motulator.drive.utils._parameters import SaturatedSynchronousMachinePars
from scipy.interpolate import RectBivariateSpline

STEPS_MAX = 60
CONVERGED = 1e-9


def main() -> None:
    """Compute the table of the file in the first argument."""
    data = np.load(sys.argv[1])
    grids = data["psi_d_wb"], data["psi_q_wb"]
    flux_d, flux_q = (RectBivariateSpline(data["i_d_a"], data["i_q_a"], grid, s=0) for grid in grids)
    low_d, high_d, low_q, high_q = (float(axis[k]) for axis in (data["i_d_a"], data["i_q_a"]) for k in (0, -1))

    def flux(i: Any) -> Any:
        d, q = np.real(i), np.imag(i)
        c, e = np.clip(d, low_d, high_d), np.clip(q, low_q, high_q)
        value = flux_d.ev(c, e) + 1j * flux_q.ev(c, e)
        if np.any((c != d) | (e != q)):  # the loci ask beyond the data: continued by the slope at its edge
            value = value + (d - c) * (flux_d.ev(c, e, dx=1) + 1j * flux_q.ev(c, e, dx=1))
            value = value + (q - e) * (flux_d.ev(c, e, dy=1) + 1j * flux_q.ev(c, e, dy=1))
        return complex(value) if np.ndim(i) == 0 else value

    I_max, V_max = float(data["I_max"]), float(data["V_max"])
    torque, omega = data["torque_nm"], data["omega_e"]
    start = time.process_time()
    par = SaturatedSynchronousMachinePars(n_p=int(data["pole_pairs"]), R_s=float(data["R"]), psi_s_dq_fcn=flux)
    generator = ReferenceGenerator(par, I_max, None, float(data["psi_max"]), 1.0, 1.0, 1.0)
    found = np.empty((torque.size, omega.size), dtype=complex)
    for y, w in enumerate(omega):
        for x, T in enumerate(torque):
            generator.compute_flux_and_torque_refs(float(T), float(w), math.sqrt(3.0) * V_max)
            for _ in range(STEPS_MAX):
                before = generator.i_s_ref
                generator.update(1.0)
                if abs(generator.i_s_ref - before) <= CONVERGED * I_max:
                    break
            if not np.isfinite(generator.i_s_ref) or abs(generator.i_s_ref) > 3.0 * I_max:
                generator.i_s_ref = complex(generator.i_s_mtpa(abs(float(T))))  # lost: start again where it may hold
            found[x, y] = generator.compute_current_ref(float(T))
    seconds = time.process_time() - start
    np.savez(sys.argv[2], i_d_a=found.real, i_q_a=found.imag, seconds=seconds)


if __name__ == "__main__":
    main()
