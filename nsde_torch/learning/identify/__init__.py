"""Least-squares identification of declared physics in weak form (see `identify`)."""
