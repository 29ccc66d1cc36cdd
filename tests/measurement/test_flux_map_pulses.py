# SPDX-License-Identifier: MIT
"""Before the pulses of a flux map a shaft is at rest, however heavy it is."""

from typing import cast

import pytest

from pmsmtool.drive.port import Drive
from pmsmtool.experiments import flux_map_scan
from pmsmtool.experiments.speed_run import RAMP_MOST_S


class Braked:
    """A shaft that a speed controller brakes evenly; not below ``rest_rad_s``, where cogging moves it on."""

    period_s = 1e-4

    def __init__(self, omega_e_rad_s: float, per_s: float, rest_rad_s: float = 0.0) -> None:
        self.omega, self.per_s, self.rest, self.waited = omega_e_rad_s, per_s, rest_rad_s, 0.0

    def command_speed(self, rad_s: float) -> None:
        assert rad_s == 0.0

    def wait(self, seconds: float) -> None:
        self.waited += seconds
        self.omega = max(self.rest, self.omega - self.per_s * seconds)

    def average(self, names: tuple[str, ...], periods: int) -> dict[str, float]:
        return {"omega_e_rad_s": -self.omega}


@pytest.mark.parametrize(("rest_rad_s", "waits_s"), [(0.0, 10.0), (8.0, 9.9 + flux_map_scan.BRAKE_LIMIT_S)])
def test_a_heavy_shaft_is_at_rest_before_the_pulses(rest_rad_s: float, waits_s: float) -> None:
    """It was left turning after 0.6 s: its back-EMF drove a current over the abort limit, and the run was lost."""
    drive = Braked(500.0, 50.0, rest_rad_s)
    flux_map_scan._brake(cast(Drive, drive), 1.0)
    assert drive.waited == pytest.approx(waits_s, abs=0.15) and drive.omega <= max(rest_rad_s, 1.0)


def test_a_shaft_that_never_stops_is_waited_for_so_long() -> None:
    drive = Braked(1e6, 5e4)
    flux_map_scan._brake(cast(Drive, drive), 0.0)
    assert drive.waited <= RAMP_MOST_S + 0.1
