# SPDX-License-Identifier: MIT
"""The numbers of the signals of drive and plant (``pmsm_application.h``, ``closed_loop.h``)."""

from __future__ import annotations

from enum import IntEnum


class Signal(IntEnum):
    """A quantity that can be read, recorded, averaged or triggered on (``enum pmsm_signal``)."""

    NONE = 0
    I_D = 1
    I_Q = 2
    I_D_REQ = 3
    I_Q_REQ = 4
    I_D_REF = 5
    I_Q_REF = 6
    U_D = 7
    U_Q = 8
    U_D_LIM = 9
    U_Q_LIM = 10
    THETA_E = 11
    OMEGA_E = 12
    TAU = 13
    KAPPA = 14
    BINDING = 15
    ITERATIONS = 16
    FLAGS = 17
    I_A = 18
    I_B = 19
    I_C = 20
    U_DC = 21
    T_WINDING = 22
    T_MAGNET = 23
    THETA_M = 24
    FOLLOWING_ERROR = 25
    HALL = 26


class Truth(IntEnum):
    """Signals of the plant (``enum pmsm_truth``), numbered on beside those of the drive (:class:`Signal`)."""

    T = 64
    I_D = 65
    I_Q = 66
    I_A = 67
    I_B = 68
    I_C = 69
    PSI_D = 70
    PSI_Q = 71
    PSI_ALPHA = 72
    PSI_BETA = 73
    THETA_E = 74
    THETA_M = 75
    OMEGA_M = 76
    TORQUE = 77
    LOAD = 78
    U_DC = 79
    T_WINDING = 80
    T_MAGNET = 81
    DUTY_A = 82
    DUTY_B = 83
    DUTY_C = 84
    GATES = 85
    U_ALPHA = 86
    U_BETA = 87
    OMEGA_LOAD = 88
    TWIST = 89
    R = 90
    U_ALPHA_MEAN = 91
    U_BETA_MEAN = 92
    TRIP = 93
