"""`nsde completion SHELL`: print the script that teaches a shell to complete `nsde`.

The script asks `nsde completion query WORD...` at every press of the tab key; the answer needs neither Hydra
nor torch.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from ..exit_status import OK, USER_ERROR
from ..registry import PlainCommand, all_commands, entry_of

_BASH = """\
_nsde_complete() {
    local line="${COMP_LINE:0:COMP_POINT}" words current offset
    read -ra words <<< "$line"
    [[ "$line" == *" " ]] && words+=("")
    current="${words[${#words[@]}-1]}"
    mapfile -t COMPREPLY < <("${words[0]}" completion query "${words[@]:1}" 2>/dev/null)
    # Bash replaces only what follows the last of its word breaks (= and :), so cut what stands before it.
    if [[ "$COMP_WORDBREAKS" == *"="* && "$current" == *"="* ]]; then
        offset="${current%"${current##*=}"}"
        COMPREPLY=("${COMPREPLY[@]#"$offset"}")
    fi
    [[ ${#COMPREPLY[@]} -eq 1 && "${COMPREPLY[0]}" != *[=./] ]] && COMPREPLY[0]+=" "
}
complete -o nospace -F _nsde_complete nsde
"""

_ZSH = """\
#compdef nsde
_nsde() {
    local -a answers
    answers=("${(@f)$(${words[1]} completion query "${(@)words[2,CURRENT]}" 2>/dev/null)}")
    compadd -Q -S '' -- ${answers:#}
}
compdef _nsde nsde
"""

_FISH = """\
function __nsde_complete
    set -l words (commandline -opc) (commandline -ct)
    $words[1] completion query $words[2..-1] 2>/dev/null
end
complete -c nsde -f -a '(__nsde_complete)'
"""

SCRIPTS = {"bash": _BASH, "zsh": _ZSH, "fish": _FISH}

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
    if words[0] not in SCRIPTS or len(words) > 1:
        print(
            f"nsde completion: expected one of {', '.join(SCRIPTS)}; got {' '.join(words)}.", file=sys.stderr
        )
        return USER_ERROR
    print(SCRIPTS[words[0]], end="")
    return OK


def complete(words: Sequence[str]) -> list[str]:
    """Completions of this command's own argument."""
    return [shell for shell in SCRIPTS if shell.startswith(words[-1])] if len(words) == 1 else []


def query(words: Sequence[str]) -> list[str]:
    """Completions of the last of the words typed after `nsde`."""
    if len(words) <= 1:
        start = words[0] if words else ""
        return [name for name in [*all_commands(), "--help", "--version"] if name.startswith(start)]
    entry = entry_of(words[0])
    return entry.load().complete(words[1:]) if entry else []


COMMAND = PlainCommand(main, complete)
