"""A simulated autopilot that a link meets as it would meet PX4, and flights on it."""

__all__ = ["CLOCK"]

CLOCK = 0.993
"""Seconds of a simulated vehicle's clock in one of ours: PX4's own simulator was seen to run 0.6 to 0.8 % slow."""
