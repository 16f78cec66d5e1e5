"""A flight over a link: checks before it, its phases, what watches it, who flies it, and its log."""

__all__: list[str] = []
