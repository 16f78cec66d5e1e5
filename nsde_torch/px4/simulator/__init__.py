"""A simulated autopilot that a link meets as it would meet PX4, and flights on it."""

__all__: list[str] = []
