"""Machines for these tests."""

from tests.helpers.hexacopters import declared, model, path

__all__ = ["declared", "model", "path"]
