"""How fast the clock of a simulated vehicle runs; apart, so that listing the keys of a command imports no vehicle."""

CLOCK = 0.993  # seconds of its clock in one of ours: PX4's own simulator was seen to run 0.6 to 0.8 % slow
