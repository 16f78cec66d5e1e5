"""Exceptions for faults of the user's input; each message names the thing, what was expected and the remedy."""


class NsdeError(Exception):
    """Base class of every error that a user can cause and mend."""


class ShapeError(NsdeError, ValueError):
    """A tensor has the wrong shape; the message names the argument and the expected axes."""


class DataError(NsdeError, ValueError):
    """A data set cannot be used as it is; the message names file, column or row and the remedy."""


class ConfigError(NsdeError, ValueError):
    """A setting is unknown or out of range; the message lists the choices."""


class SolverError(NsdeError, ValueError):
    """A numerical method does not fit the problem it was given (calculus, noise, derivative)."""


class NonFiniteError(NsdeError, ArithmeticError):
    """A computation left the finite numbers; the message names step, time and rows."""


class CheckpointError(NsdeError, RuntimeError):
    """A run directory or checkpoint is missing, damaged or from another configuration."""


class ExportError(NsdeError, RuntimeError):
    """An exported controller is damaged, of another version, or cannot be made; the message says why."""
