"""`nsde completion`: print the shell completion script for bash, zsh or fish.

The script asks `nsde completion query WORD...` at every press of the tab key; the answer needs neither Hydra
nor torch.
"""

from collections.abc import Sequence
from importlib import resources

from nsde_torch.errors import ConfigError

from ..exit_status import OK, USER_ERROR
from ..registry import PlainCommand, all_commands, entry_of

SHELLS = ("bash", "zsh", "fish")

_HELP = """\
nsde completion: print the completion script of a shell

Usage: nsde completion bash|zsh|fish

To have it in every new shell:
  bash   echo 'eval "$(nsde completion bash)"' >> ~/.bashrc
  zsh    echo 'eval "$(nsde completion zsh)"' >> ~/.zshrc        (after compinit)
  fish   nsde completion fish > ~/.config/fish/completions/nsde.fish"""


def main(arguments: Sequence[str]) -> int:
    """Print a script, or answer a query of one."""
    words = list(arguments)
    if not words or words[0] in ("-h", "--help"):
        print(_HELP)
        return OK if words else USER_ERROR
    if words[0] == "query":
        print("\n".join(query(words[1:])))
        return OK
    if words[0] not in SHELLS or len(words) > 1:
        raise ConfigError(f"expected one of {', '.join(SHELLS)}; got {' '.join(words)}.")
    file = resources.files("nsde_torch.cli").joinpath("shell", f"nsde.{words[0]}")
    print(file.read_text(encoding="utf-8"), end="")
    return OK


def complete(words: Sequence[str]) -> list[str]:
    """Completions of this command's own argument."""
    return [shell for shell in SHELLS if shell.startswith(words[-1])] if len(words) == 1 else []


def query(words: Sequence[str]) -> list[str]:
    """Completions of the last of the words typed after `nsde`."""
    if len(words) <= 1:
        start = words[0] if words else ""
        return [name for name in [*all_commands(), "--help", "--version"] if name.startswith(start)]
    entry = entry_of(words[0])
    return entry.load().complete(words[1:]) if entry else []


COMMAND = PlainCommand(main, complete)
