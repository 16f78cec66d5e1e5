"""Plans and estimators as C: for files that are exported, and for libraries that the controller here calls."""

__all__: list[str] = []
