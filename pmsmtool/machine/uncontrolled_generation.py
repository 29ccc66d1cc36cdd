# SPDX-License-Identifier: MIT
"""The speed from which a machine without control charges the DC link, and what a short circuit does instead.

With the gates off the diodes rectify the back-EMF: above the speed at which its line-to-line amplitude reaches the
link's limit the rotor drives the voltage there (Jahns and Caliskan, IEEE Trans. Ind. Appl. 35 (1999) 1347-1357).
A brake chopper or a battery that takes the rectified current, psi_f/L_d at most, holds it. Shorted windings keep the
link out of it; their flux linkage stands still in the stator frame while the rotor turns, so i_d passes
-(psi_f + |psi|)/L_d, |psi| being the linkage at the instant of the short circuit; R takes some of that away. With
neither, no speed beyond it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from pmsmtool.errors import DesignInfeasible
from pmsmtool.machine.parameters import MachineParameters
from pmsmtool.machine.temperature import magnet_flux_at
from pmsmtool.units import rpm_from_rad_s

COLD_C = 0.0
"""Temperature (degC) of the strongest magnet that is reckoned with: started up in an unheated hall."""

Protection = Literal["chopper", "battery", "short-circuit"]
"""What keeps the link below its limit at a fault: a brake chopper or a battery that a person states, or shorted
windings."""
STATED: dict[Protection | None, str] = {"chopper": "brake chopper", "battery": "battery"}
"""Those that the tool takes a person's word for."""
SPEED_ROOM = 1.05
"""Over-speed trip over the largest speed, at least: what a speed loop overshoots."""
UNLIKELY_TIMES = 3.0
"""Back-EMF at the rated speed over the DC link above which the unit of psi_f is the likelier cause."""
HINT = (
    "state what takes the energy: --overspeed-protection chopper (or U_dc_chopper_v), or battery where one feeds the "
    "link; or lower n_max_rpm"
)


def generation_rpm(machine: MachineParameters, U_dc_max_v: float) -> float:
    """Return U / (sqrt(3) p psi_cold) as a mechanical speed (rpm); infinity without a magnet."""
    psi = _cold(machine)
    return rpm_from_rad_s(U_dc_max_v / (math.sqrt(3.0) * machine.pole_pairs * psi)) if psi > 0.0 else math.inf


def _cold(machine: MachineParameters) -> float:
    return float(max(magnet_flux_at(machine, COLD_C), machine.psi_f_wb))


@dataclass(frozen=True, slots=True)
class FaultReaction:
    """What a fault does to the inverter."""

    generation_rpm: float
    """Speed of uncontrolled generation (rpm)."""
    short_from_rpm: float
    """Speed (rpm) above which a fault shorts the windings; 0: it removes the gates at every speed."""
    trip_most_rpm: float
    """Largest over-speed trip (rpm) at which this reaction keeps the link below its limit; infinity: any."""
    how: str
    """Why."""
    note: str
    """What a person must see to; empty when there is nothing."""

    @property
    def n_most_rpm(self) -> float:
        """Largest speed (rpm) below that trip."""
        return self.trip_most_rpm / SPEED_ROOM


def fault_reaction(
    machine: MachineParameters,
    U_dc_nom_v: float,
    U_dc_max_v: float,
    n_trip_rpm: float,
    i_d_min_a: float,
    protection: Protection | None = None,
) -> FaultReaction:
    """Choose between gates off and, above the speed of uncontrolled generation, a short circuit.

    Raises DesignInfeasible: a short circuit is asked for that demagnetises the machine; or nothing protects the link at
    a fault at the machine's rated speed.

    Parameters
    ----------
    machine : MachineParameters
        Magnet, inductance and pole pairs.
    U_dc_nom_v, U_dc_max_v : float
        Nominal voltage of the link and its limit (V).
    n_trip_rpm : float
        Largest speed at which a fault can occur (rpm), as asked for.
    i_d_min_a : float
        Most negative i_d that the magnet stands (A).
    protection : str, optional
        What a person states or asks for; None: a short circuit where the magnet stands it, else no speed beyond.
    """
    any_rpm = math.inf
    from_rpm = generation_rpm(machine, U_dc_max_v)
    if n_trip_rpm <= from_rpm:
        return FaultReaction(from_rpm, 0.0, any_rpm, "gates off: the back-EMF stays below U_dc_max at n_trip", "")
    psi = _cold(machine)
    if protection in STATED:
        rectified, notes = -psi / machine.L_d_decoupling_h, []
        if protection == "battery":
            notes.append(
                f"a fault above {from_rpm:.4g} rpm feeds up to {-rectified:.4g} Apk of rectified current into the "
                "battery: its protection must not open there, also when it is full"
            )
        if rectified < i_d_min_a:
            notes.append(
                f"a fault above {from_rpm:.4g} rpm rectifies through the {STATED[protection]}: i_d can reach "
                f"{rectified:.4g} A, beyond the {i_d_min_a:.4g} A allowed (magnet)"
            )
        how = f"gates off: a {STATED[protection]} holds the DC link, as stated"
        return FaultReaction(from_rpm, 0.0, any_rpm, how, "; ".join(notes))
    # from where the back-EMF reaches the nominal link: the linkage at the voltage limit is that of the magnet there
    peak = -2.0 * psi / machine.L_d_decoupling_h
    if peak >= i_d_min_a:
        how = f"short circuit where the EMF reaches U_dc: i_d to {peak:.4g} A at most, {i_d_min_a:.4g} A allowed"
        return FaultReaction(from_rpm, generation_rpm(machine, U_dc_nom_v), any_rpm, how, "")
    what = (
        f"a fault above {from_rpm:.4g} rpm charges the DC link over {U_dc_max_v:.4g} V (uncontrolled generation, up to "
        f"n_trip {n_trip_rpm:.4g} rpm); a short circuit would take i_d to {peak:.4g} A, beyond the "
        f"{i_d_min_a:.4g} A allowed"
    )
    if protection is not None or (machine.n_nom_rpm or 0.0) > from_rpm / SPEED_ROOM:
        times = (machine.n_nom_rpm or 0.0) / generation_rpm(machine, U_dc_nom_v)
        likely = f"psi_f_wb in another unit: at the rated speed it makes {times:.3g} times the DC link"
        raise DesignInfeasible(
            what, where="--overspeed-protection" if protection else "n_nom_rpm",
            likely=likely if times > UNLIKELY_TIMES else "", hint=HINT,
        )  # fmt: skip
    note = f"largest speed {from_rpm / SPEED_ROOM:.4g} rpm, trip at {from_rpm:.4g} rpm: {what}; {HINT}"
    return FaultReaction(from_rpm, 0.0, from_rpm, "gates off: a short circuit takes i_d beyond its limit", note)
