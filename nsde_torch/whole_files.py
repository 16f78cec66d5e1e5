"""Files that are written whole or not at all, whatever stops the program."""

from pathlib import Path


def write_whole(path: Path, text: str) -> None:
    """Write a text file, in place of the one that is there.

    Args:
        path: The file.
        text: What it is to hold.
    """
    part = path.with_name(f"{path.name}.part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)
