"""The link: MAVLink 2 frames, telemetry and setpoints, over whatever carries bytes.

NED world and FRD body exist here and in the simulated autopilot only; `frames` converts at the border, once.
"""

__all__: list[str] = []
