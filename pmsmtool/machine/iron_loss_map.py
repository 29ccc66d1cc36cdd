# SPDX-License-Identifier: MIT
"""Iron-loss maps: P_fe = c_h f + c_e f^2 over the current plane, f the electrical frequency in Hz.

Format: ``.npz`` with the axes ``i_d_a``, ``i_q_a`` (A peak, increasing) and the grids ``c_h_w_per_hz`` (hysteresis) and
``c_e_w_per_hz2`` (eddy currents), shape (n_d, n_q). Interpolated like a flux map (bicubic). Separation after Bertotti
(1988, DOI 10.1109/20.43994) without the excess term.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pmsmtool.errors import ConfigError, next_step
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.npz_file import read_npz

NEXT_STEP = "`pmsmtool help files` says what an iron-loss map holds"

_NAMES = ("i_d_a", "i_q_a", "c_h_w_per_hz", "c_e_w_per_hz2")


@next_step(NEXT_STEP)
def load_iron_loss_map(path: Path) -> FluxMap:
    """Read a map; its ``psi_d_wb`` carries c_h (W/Hz), its ``psi_q_wb`` carries c_e (W/Hz^2).

    Raises ConfigError: the file is no archive, lacks an array, or its grids do not fit or are negative.
    """
    arrays = read_npz(path)
    missing = [name for name in _NAMES if name not in arrays]
    if missing:
        hint = f"an iron-loss map has {', '.join(_NAMES)}"
        raise ConfigError(f"holds no {', '.join(missing)}", where=str(path), hint=hint)
    i_d, i_q, c_h, c_e = (np.asarray(arrays[name], dtype=np.float64) for name in _NAMES)
    if min(float(np.nanmin(c_h)), float(np.nanmin(c_e))) < 0.0:
        raise ConfigError("holds a negative loss coefficient", where=str(path))
    try:
        return FluxMap(i_d, i_q, c_h, c_e)
    except ConfigError as error:
        raise ConfigError("is not an iron-loss map", where=str(path), violations=error.violations) from None
