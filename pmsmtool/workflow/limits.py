"""What the experiments of an identification may use: current, speed and voltage."""

from __future__ import annotations

from dataclasses import dataclass

from pmsmtool.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Limits:
    """What the experiments may use.

    Attributes
    ----------
    I_nom_apk : float
        Rated current; the scale of every amplitude (A peak).
    i_max_apk : float
        Largest current of the envelope (A peak).
    omega_max_rad_s : float
        Largest mechanical speed of the envelope (rad/s).
    V_max_v : float
        Largest voltage (V peak).

    Raises
    ------
    ConfigError
        One of them leaves nothing.
    """

    I_nom_apk: float
    i_max_apk: float
    omega_max_rad_s: float
    V_max_v: float

    def __post_init__(self) -> None:
        """Refuse before anything moves."""
        for what, value, unit in (
            ("rated current", self.I_nom_apk, "A"),
            ("largest current", self.i_max_apk, "A"),
            ("largest speed", self.omega_max_rad_s, "rad/s"),
            ("largest voltage", self.V_max_v, "V"),
        ):
            if not value > 0.0:
                raise ConfigError(
                    f"{what} is {value:.4g} {unit}: nothing can be measured",
                    hint="give --i-max and --speed-max above zero, and ratings above zero in the machine file",
                )

    @property
    def I_test_apk(self) -> float:
        """Largest steady current of an experiment: the rated one, or what the envelope leaves."""
        return min(self.I_nom_apk, self.i_max_apk / 1.1)
