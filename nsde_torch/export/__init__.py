"""The controller as a file for the flight computer."""
