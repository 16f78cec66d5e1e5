"""The faults of a recording chain, a file each; `registry` lists them."""

__all__: list[str] = []
