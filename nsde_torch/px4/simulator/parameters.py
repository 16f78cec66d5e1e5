"""The parameters of the simulated autopilot: those of PX4 that it heeds or is asked for."""

from __future__ import annotations

from nsde_torch.px4.link import dialect as d

PARAMETERS: dict[str, tuple[float, int]] = {
    "SYS_AUTOSTART": (6001, d.INT32),
    "COM_OF_LOSS_T": (1.0, d.REAL32),
    "COM_OBL_RC_ACT": (4, d.INT32),  # 4: land
    "COM_RC_IN_MODE": (4, d.INT32),  # no sticks
    "COM_RC_OVERRIDE": (1, d.INT32),
    "COM_RCL_EXCEPT": (0, d.INT32),
    "COM_DLL_EXCEPT": (0, d.INT32),
    "NAV_RCL_ACT": (2, d.INT32),
    "NAV_DLL_ACT": (0, d.INT32),
    "GF_ACTION": (2, d.INT32),
    "GF_MAX_HOR_DIST": (0.0, d.REAL32),  # 0: no fence
    "GF_MAX_VER_DIST": (0.0, d.REAL32),
    "SENS_GPS0_DELAY": (10.0, d.REAL32),
    "COM_LOW_BAT_ACT": (2, d.INT32),
    "RTL_RETURN_ALT": (30.0, d.REAL32),
    "SDLOG_PROFILE": (147, d.INT32),
    "COM_DISARM_LAND": (2.0, d.REAL32),
    "COM_DISARM_PRFLT": (10.0, d.REAL32),
    "MPC_THR_HOVER": (0.5, d.REAL32),
    "MPC_LAND_SPEED": (0.7, d.REAL32),
    "MC_ROLLRATE_MAX": (220.0, d.REAL32),
    "MC_PITCHRATE_MAX": (220.0, d.REAL32),
    "MC_YAWRATE_MAX": (200.0, d.REAL32),
    "BAT1_N_CELLS": (4, d.INT32),
    "MAV_SYS_ID": (1, d.INT32),
}
"""The parameters that are answered for."""
FAILSAFES = {0: d.POSITION, 1: d.ALTITUDE, 2: d.MANUAL, 4: d.LAND}
"""Modes of COM_OBL_RC_ACT in which it ends without a stream; HOLD in all others."""
MOTORS_OFF = (6, 7)
"""Values of COM_OBL_RC_ACT that stop the motors wherever it is: flight termination, and disarming."""
STICK_MODES = (d.POSITION, d.ALTITUDE, d.MANUAL)
