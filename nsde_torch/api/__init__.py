"""What the command line does, in one call each: the functions of `nsde_torch` itself.

The commands call these functions, so that a model trained in Python is the model that `nsde train` trains.
"""

__all__: list[str] = []
