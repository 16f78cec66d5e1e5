"""PX4: a MAVLink 2 link, an offboard state machine that flies a controller on it, and a simulated autopilot.

NED world and FRD body exist inside this package only; `frames` converts at its border, once.
"""
