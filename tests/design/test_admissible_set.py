# SPDX-License-Identifier: MIT
"""Prediction model and horizon: printed entries, published horizons, and no violation that the horizon did not see."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.design.admissible_set import PredictionModel, StateBounds, horizon
from pmsmtool.design.loops.current_loop import imc, second_order
from pmsmtool.errors import DesignInfeasible

R, L_D, L_Q, PSI, P, T_S = 0.137, 2.3e-3, 2.1e-3, 0.41, 4, 1.0 / 12e3
V_MAX = 210.0 / math.sqrt(3.0)
OMEGA = 620.0 * P * math.pi / 30.0

MODULUS_OPTIMUM = PredictionModel(R, L_D, L_Q, PSI, T_S, imc(R, L_D, 4000.0), imc(R, L_Q, 4000.0))
SECOND_ORDER = PredictionModel(
    R, L_D, L_Q, PSI, T_S, second_order(R, L_D, 2000.0, 1.0), second_order(R, L_Q, 2000.0, 1.0)
)

HORIZON_TOLERANCE = 1
"""Rows; the published numbers come from another solver (measured here: no difference)."""


def test_entries_of_the_matrices() -> None:
    """(20) and (27) written out by hand, with the missing minus signs of the text copies."""
    m = MODULUS_OPTIMUM
    K_pd, K_id, K_pq, K_iq = m.gains_d.K_p, m.gains_d.K_i, m.gains_q.K_p, m.gains_q.K_i
    expected = np.array(
        [
            [1 - T_S * (R + K_pd) / L_D, 0, T_S * K_id / L_D, 0, T_S * K_pd / L_D, 0],
            [0, 1 - T_S * (R + K_pq) / L_Q, 0, T_S * K_iq / L_Q, 0, T_S * K_pq / L_Q],
            [-T_S, 0, 1, 0, T_S, 0],
            [0, -T_S, 0, 1, 0, T_S],
            [0, 0, 0, 0, 1, 0],
            [0, 0, 0, 0, 0, 1],
        ]
    )
    assert np.abs(m.system_matrix() - expected).max() <= 1e-12
    rows = [[-K_pd, -OMEGA * L_Q, K_id, 0, K_pd, 0], [OMEGA * L_D, -K_pq, 0, K_iq, 0, K_pq]]
    assert np.abs(m.voltage_rows(OMEGA) - np.array(rows)).max() <= 1e-12


def test_the_matrix_is_eulers_rule_on_the_controlled_machine() -> None:
    """(15)-(16) stepped with decoupling: the rotation voltages cancel and what is left is A x."""
    rng = np.random.default_rng(2)
    for m in (MODULUS_OPTIMUM, SECOND_ORDER):
        x = rng.normal(size=6)
        (i_d, i_q, I_d, I_q, v_d, v_q), A = x, m.system_matrix()
        s_d = m.gains_d.K_p * (v_d - i_d) + m.gains_d.K_i * I_d
        s_q = m.gains_q.K_p * (v_q - i_q) + m.gains_q.K_i * I_q
        following = [
            i_d + T_S / L_D * (s_d - R * i_d), i_q + T_S / L_Q * (s_q - R * i_q),
            I_d + T_S * (v_d - i_d), I_q + T_S * (v_q - i_q), v_d, v_q,
        ]  # fmt: skip
        assert A @ x == pytest.approx(following, rel=1e-12)
        demanded = m.voltage_rows(OMEGA) @ x + m.offset(OMEGA)
        rotation = [-OMEGA * L_Q * i_q, OMEGA * (L_D * i_d + PSI)]
        assert demanded == pytest.approx([s_d + rotation[0], s_q + rotation[1]], rel=1e-12)


@pytest.mark.chain
@pytest.mark.parametrize(
    ("model", "eps", "published"),
    [
        (MODULUS_OPTIMUM, 0.1, 18), (MODULUS_OPTIMUM, 0.01, 24), (MODULUS_OPTIMUM, 1e-3, 34),
        (SECOND_ORDER, 0.1, 14), (SECOND_ORDER, 0.01, 23), (SECOND_ORDER, 1e-3, 33), (SECOND_ORDER, 1e-4, 43),
    ],
)  # fmt: skip
def test_published_horizons(model: PredictionModel, eps: float, published: int) -> None:
    found = horizon(model, OMEGA, V_MAX, eps)
    assert found.k_max is not None
    assert abs(found.k_max - published) <= HORIZON_TOLERANCE
    assert found.text == str(found.k_max)


@pytest.mark.parametrize("eps", [1e-4, None])
def test_what_is_not_finitely_determined_is_said_so(eps: float | None) -> None:
    found = horizon(MODULUS_OPTIMUM, OMEGA, V_MAX, eps)
    assert found.k_max is None
    assert found.text == "not finitely determined"


def test_a_horizon_takes_few_linear_solutions(monkeypatch: pytest.MonkeyPatch) -> None:
    """267 of all directions at once; 1930 one direction after the other, each to its end."""
    solved, solve = [], np.linalg.solve
    monkeypatch.setattr(np.linalg, "solve", lambda *system: solved.append(1) or solve(*system))
    model = replace(MODULUS_OPTIMUM, T_s=1.01 * T_S)  # one that nothing has asked for yet
    assert horizon(model, OMEGA, V_MAX, 0.01).k_max is not None
    assert 0 < len(solved) < 1000


@pytest.mark.chain
@pytest.mark.parametrize(("rpm", "published"), [(0.0, 0), (310.0, 0), (620.0, 14), (800.0, 29)])
def test_horizons_of_states_that_can_occur_depend_on_speed(rpm: float, published: int) -> None:
    found = horizon(MODULUS_OPTIMUM, rpm * P * math.pi / 30.0, V_MAX, 1e-3, StateBounds(56.0, 2.0))
    assert found.k_max is not None
    assert abs(found.k_max - published) <= HORIZON_TOLERANCE


@pytest.mark.chain
def test_all_states_give_the_same_horizon_at_every_speed_but_zero() -> None:
    assert {horizon(MODULUS_OPTIMUM, w, V_MAX, 0.1).k_max for w in (100.0, 300.0, -500.0)} == {18}
    assert horizon(MODULUS_OPTIMUM, 0.0, V_MAX, 0.1).k_max == 0


@pytest.mark.chain
def test_no_state_inside_the_rows_violates_a_later_one() -> None:
    """Random states near the limit, pulled back until the rows of the horizon hold, then predicted on."""
    m, eps = MODULUS_OPTIMUM, 0.01
    k_max = horizon(m, OMEGA, V_MAX, eps).k_max
    assert k_max is not None
    rows = m.predicted_rows(OMEGA, 6 * k_max) / V_MAX
    steady = m.steady_state_rows(OMEGA) / V_MAX
    centre = np.zeros(6)
    centre[[0, 4]] = -PSI / L_D  # zero steady-state voltage but for the resistance
    centre[2] = R * centre[0] / m.gains_d.K_i
    offset = m.offset(OMEGA) / V_MAX
    rng = np.random.default_rng(0)
    three = np.concatenate((steady, rows[0], rows[1]))

    def largest(kept: int, x: np.ndarray) -> float:
        """Pull a state towards the centre until its kept rows hold, then look at all later ones."""
        low, high = 0.0, 1.0
        for _ in range(50):
            middle = 0.5 * (low + high)
            at = centre + middle * (x - centre)
            inside = np.hypot(*(rows[: kept + 1] @ at + offset).T).max() <= 1.0
            inside &= np.hypot(*(steady @ at + offset)) <= 1.0 - eps
            low, high = (middle, high) if inside else (low, middle)
        return float(np.hypot(*(rows[kept + 1 :] @ (centre + low * (x - centre)) + offset).T).max())

    worst_inside = worst_short = 0.0
    for _ in range(500):
        # a state by the voltages it stands for: steady state, now, and one sample ahead, all near the limit
        angle = rng.uniform(0.0, 2.0 * math.pi) + rng.normal(0.0, 0.2, 3) + np.array([0.0, math.pi, math.pi])
        size = np.array([1.0 - eps, 1.0, rng.uniform(0.2, 1.0)])
        wanted = np.column_stack((size * np.cos(angle), size * np.sin(angle))) - offset
        x = np.linalg.solve(three, wanted.ravel())
        worst_inside = max(worst_inside, largest(k_max, x))
        worst_short = max(worst_short, largest(k_max // 6, x))
    assert worst_inside <= 1.0 + 2e-6
    assert worst_short > 1.0005


def test_the_straight_segment_is_recognised() -> None:
    assert MODULUS_OPTIMUM.has_straight_segment()
    assert not SECOND_ORDER.has_straight_segment()
    other = PredictionModel(R, L_D, L_Q, PSI, T_S, imc(R, L_D, 4000.0), imc(R, L_Q, 3000.0))
    assert not other.has_straight_segment()
    slower = (replace(gains, K_i=0.5 * gains.K_i) for gains in (imc(R, L_D, 4000.0), imc(R, L_Q, 4000.0)))
    assert not PredictionModel(R, L_D, L_Q, PSI, T_S, *slower).has_straight_segment()


def test_an_unstable_prediction_is_refused() -> None:
    fast = PredictionModel(R, L_D, L_Q, PSI, T_S, imc(R, L_D, 30e3), imc(R, L_Q, 30e3))
    with pytest.raises(DesignInfeasible, match="unstable"):
        horizon(fast, OMEGA, V_MAX, 0.01)


def test_a_state_close_to_the_border_of_one_disc_ends_in_no_singular_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    """The curvature had one direction of six, to rounding, and the command ended in exit 70."""

    def singular(*system: object) -> None:
        raise np.linalg.LinAlgError

    plain = horizon(SECOND_ORDER, OMEGA, V_MAX, 0.1)
    monkeypatch.setattr(np.linalg, "solve", singular)
    assert horizon(SECOND_ORDER, OMEGA, V_MAX, 0.1, cap=20) == plain  # another cap, so that it is computed
