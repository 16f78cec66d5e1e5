#compdef nsde
_nsde() {
    local -a answers
    answers=("${(@f)$(${words[1]} completion query "${(@)words[2,CURRENT]}" 2>/dev/null)}")
    compadd -Q -S '' -- ${answers:#}
}
compdef _nsde nsde
